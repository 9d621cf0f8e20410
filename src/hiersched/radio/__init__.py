"""Fading, path loss and the rate of a resource block."""
