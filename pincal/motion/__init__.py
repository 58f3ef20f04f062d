"""Arms that are measured while they move: streams, paths of the joints, clocks, and what inertia
adds to the loads.
"""
