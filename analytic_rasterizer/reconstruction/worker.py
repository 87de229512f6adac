"""The process in which COLMAP runs: a crash of it ends this process alone. It imports nothing of the package.

Pillow and torch bring libraries that pycolmap brings too, in other versions: in one process they crash.

The job is the first line of stdin, as JSON (`process.Job`). Each line of stdout is an event:

    {"stage": "features", "done": 3, "of": 16}
    {"models": [["a.jpg", "b.jpg", ..], ..], "matched": 105}     the last: models by their folders 0, 1, ..
    {"error": "..."}

What COLMAP says is on stderr.
"""

import json
import os
import sys
import threading
from pathlib import Path

if __name__ == "__main__":
    sys.path.pop(0)  # the folder of this file, whose modules are no libraries

import pycolmap

AT_ONCE = 4  # photographs per thread between two events
CHUNKS = 20  # events of the matching, at least
LEAST_PAIRS = 50  # of a chunk: photographs are loaded anew for each
SMALL_MODEL = 3  # photographs


def main() -> None:
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.dup2(2, 1)  # what C++ prints is none of our events
    pycolmap.logging.logtostderr = True
    pycolmap.set_random_seed(0)
    try:
        extract(job)
        match(job)
        models = [[job["names"][name] for name in names] for _, names in build(job)]
        say(models=models, matched=_count_matched(job))
    except Exception as error:
        say(error=str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__)


def _end_with_parent() -> None:
    """Ends this process when stdin ends, which is when the parent is gone."""
    sys.stdin.read()
    os._exit(1)


EVENTS = os.fdopen(os.dup(1), "w")


def say(**event) -> None:
    print(json.dumps(event), file=EVENTS, flush=True)


def extract(job: dict) -> None:
    """Features of the photographs that have none in the database yet, group by group: each has one camera."""
    total, done = sum(len(group["names"]) for group in job["groups"]), 0
    chunk = AT_ONCE * job["threads"]
    for group in job["groups"]:
        cameras = _cameras_of_images(job)
        known = [name for name in group["names"] if name in cameras]
        camera = cameras[known[0]] if known else None
        names = [name for name in group["names"] if name not in cameras]
        done += len(known)
        for start in range(0, len(names), chunk):
            say(stage="features", done=done, of=total)
            part = names[start : start + chunk]
            reader = pycolmap.ImageReaderOptions(camera_model=group["model"])
            if job["masks"] is not None:
                reader.mask_path = job["masks"]
            if camera is not None:
                reader.existing_camera_id = camera
            options = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], max_image_size=job["largest"])
            options.sift.max_num_features = job["features"]
            pycolmap.extract_features(
                job["database"],
                job["images"],
                part,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            if camera is None:
                cameras = _cameras_of_images(job)
                camera = next((cameras[name] for name in part if name in cameras), None)
            done += len(part)
    say(stage="features", done=done, of=total)


def _cameras_of_images(job: dict) -> dict[str, int]:
    """Cameras in the database by the names of photographs that have features."""
    with pycolmap.Database.open(job["database"]) as database:
        images = database.read_all_images()
        return {each.name: each.camera_id for each in images if database.exists_keypoints(each.image_id)}


def match(job: dict) -> None:
    """Compares the pairs; those in the database are there already."""
    pairs, temporary = job["pairs"], Path(job["database"]).with_name("pairs.txt")
    size = max(LEAST_PAIRS, -(-len(pairs) // CHUNKS))
    options = pycolmap.FeatureMatchingOptions(num_threads=job["threads"])
    for start in range(0, len(pairs), size):
        say(stage="pairs", done=start, of=len(pairs))
        temporary.write_text("".join(f"{first} {second}\n" for first, second in pairs[start : start + size]))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=str(temporary))
        pycolmap.match_image_pairs(
            job["database"], matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu
        )
    say(stage="pairs", done=len(pairs), of=len(pairs))


def _count_matched(job: dict) -> int:
    """Pairs of photographs that show the same points."""
    with pycolmap.Database.open(job["database"]) as database:
        return sum(count > 0 for count in database.read_two_view_geometry_num_inliers()[1])


def build(job: dict) -> list[tuple]:
    """The models, the largest first, written to folders 0, 1, ..: incremental, or global where that places less than
    half of the photographs."""
    count = sum(len(group["names"]) for group in job["groups"])
    say(stage="placed", done=0, of=count)
    models = _incremental(job, count)
    if 2 * max((len(names) for _, names in models), default=0) < count and _count_matched(job):
        models = max(models, _global(job), key=lambda found: len(found[0][1]) if found else 0)
    for number, (model, _) in enumerate(models):
        folder = Path(job["output"]) / str(number)
        folder.mkdir(parents=True)
        for image in model.images.values():
            image.name = job["names"][image.name]
        model.write(str(folder))
    return models


def _incremental(job: dict, count: int) -> list[tuple]:
    options = pycolmap.IncrementalPipelineOptions(num_threads=job["threads"], random_seed=0)
    options.min_model_size = max(SMALL_MODEL, min(options.min_model_size, count // 2))
    options.max_num_models = 10
    placed = [2]

    def count_next() -> None:
        placed[0] += 1
        say(stage="placed", done=min(placed[0], count), of=count)

    found = pycolmap.incremental_mapping(
        job["database"], job["images"], _scratch(job, "incremental"), options, next_image_callback=count_next
    )
    return _by_size(found)


def _global(job: dict) -> list[tuple]:
    options = pycolmap.GlobalPipelineOptions(num_threads=job["threads"], random_seed=0, image_path=job["images"])
    return _by_size(pycolmap.global_mapping(job["database"], job["images"], _scratch(job, "global"), options))


def _scratch(job: dict, name: str) -> str:
    folder = Path(job["database"]).with_name(name)
    folder.mkdir(exist_ok=True)
    return str(folder)


def _by_size(found: dict) -> list[tuple]:
    """Models with the names of their photographs, the largest first."""
    models = [
        (model, sorted(image.name for image in model.images.values() if image.has_pose)) for model in found.values()
    ]
    return sorted(models, key=lambda entry: -len(entry[1]))


if __name__ == "__main__":
    main()
