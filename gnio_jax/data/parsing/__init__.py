"""Contents of files as numbers: tables of every format, and stamps."""
