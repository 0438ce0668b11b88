"""Published layouts, one per file: which recordings there are, and how one is read."""
