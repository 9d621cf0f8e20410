"""What the air does."""
