"""How accurate pictures are, and what they cost: measurements, and the planner that recommends effects and a footprint.

reference.py  the converged integral of a picture, and how far another picture is from it
timing.py     rendering a view, timing calls in turn, memory, the machine
memory.py     whether a picture fits into the memory of a device
tables.py     tables as text, Markdown and CSV, and figures in which every footprint has its own colour
pareto.py     accuracy against time of whole pictures
baking.py     what `bake` gains for a scene
orders.py     how far pictures in two orders of splats are apart
affine.py     where the affine picture of a Gaussian is not enough
planner.py    which effects and which footprint a scene calls for; inspection.py holds what it reports
"""
