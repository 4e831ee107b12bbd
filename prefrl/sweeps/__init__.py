"""Many runs as one folder: which ones (`plan`), and how they are started (`launch`, `drive`)."""
