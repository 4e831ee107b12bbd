"""What is improved: policies, how they act and how they write."""
