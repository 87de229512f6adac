"""How accurate pictures are, and what they cost: measurements over one layer of references, timing and tables.

reference.py  the converged integral of a picture, and how far another picture is from it
timing.py     rendering a view, timing calls in turn, memory, the machine
tables.py     tables as text, Markdown and CSV, and figures in which every footprint has its own colour
errors.py     the error of a pixel's weight, for every footprint
pareto.py     accuracy against time of whole pictures
affine.py     where the affine picture of a Gaussian is not enough
planner.py    which effects and which footprint a scene calls for; inspection.py holds what it reports
"""
