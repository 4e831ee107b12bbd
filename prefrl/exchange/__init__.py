"""Files in and out: the forms in which judgements come and go."""
