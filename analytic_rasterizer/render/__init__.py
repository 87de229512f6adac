"""Rendering: from the settings and the arguments of a call to its pictures.

| module | contains |
|---|---|
| `settings`, `effects`, `order` | how to render |
| `rasterizer` | `GaussianRasterizer`; the function `render`, in which every rendering ends |
| `arguments`, `autocast` | from what users give to the arguments of the operators |
| `stages` | `project`, `list_tiles` and `blend`, each on its own |
| `sphere`, `seam` | pictures of the whole sphere |
| `outputs` | from the results of the operators to what users get |
| `advice` | a warning for programs that chose no footprint |
"""
