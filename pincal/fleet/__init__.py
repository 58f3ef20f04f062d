"""Many robots of one type: what they have in common, which of them changed and how, and the store
of their measurements.
"""
