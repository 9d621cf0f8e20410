"""Who gets which resource block, and the objective of a slot."""
