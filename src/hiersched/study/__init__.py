"""Tables, figures and verdicts, computed from the logs alone."""
