"""The robots: plant, references, motion and dexterity index."""
