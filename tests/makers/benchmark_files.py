"""What programs in benchmarks/ read and write, in a folder with the files of a scene."""

import json


def written(folder):
    """What a program wrote to out.json there."""
    return json.loads((folder / "out.json").read_text())


def files_of(folder):
    return [folder / "scene.npz", "--views", folder / "views.json", "--json", folder / "out.json"]
