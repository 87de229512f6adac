"""`distCUDA2` under the name that 3D Gaussian Splatting repositories import.

There is no `__init__.py` beside this file, and this is no compiled module, on purpose: no file of another distribution
named simple_knn is then replaced by one of ours, nor the other way round, and Python prefers the other one's compiled
`simple_knn/_C`, whichever was installed first.
"""

from analytic_simple_knn import distCUDA2

__all__ = ["distCUDA2"]
