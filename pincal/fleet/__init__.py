"""Many robots of a type: what they have in common, what changed on which, and the store of their measurements."""
