"""A page for people who label, and what stands behind it."""
