"""The two agents and how they learn (torch is used in this package only)."""
