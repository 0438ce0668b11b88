"""What files say, as numbers: tables of every format, and stamps."""
