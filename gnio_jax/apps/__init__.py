"""The applications around the method: each uses it, and nothing of it imports them."""
