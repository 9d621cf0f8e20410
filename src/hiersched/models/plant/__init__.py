"""What the robots do."""
