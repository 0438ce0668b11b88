"""What files say, as numbers: tables of every format, stamps, and units."""
