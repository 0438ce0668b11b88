"""The applications around the method: they use the other packages, which do not import them."""
