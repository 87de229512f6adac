"""Cameras: where pictures are taken from, and with which lens.

| module | contains |
|---|---|
| `camera` | `View`, and settings from a pose and focal lengths |
| `lens` | `Lens`: cameras that are no pinhole |
| `rotations` | rotations and small matrices |
| `focus`, `up` | what cameras look at, and which direction is up |
| `path` | camera paths for films |
"""
