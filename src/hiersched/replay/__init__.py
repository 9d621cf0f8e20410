"""Logs questioned: computed again, run again under another policy, compared slot by slot."""
