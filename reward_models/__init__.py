"""What is fitted on judgements."""
