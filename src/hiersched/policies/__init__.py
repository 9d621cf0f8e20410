"""What decides over a slot."""
