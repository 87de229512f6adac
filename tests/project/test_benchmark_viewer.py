"""Programs in benchmarks/ that compare the viewer's shaders with the library."""

import dataclasses
import importlib
import shutil

import pages
import pytest
from benchmark_files import written

pytestmark = pytest.mark.usefixtures("imports_of_benchmarks")


def test_viewer_gpu(small_scene, run):
    """The page's shaders under OpenGL draw what the rasterizer does, also from a prepared file; other pictures are
    noticed."""
    pytest.importorskip("moderngl", reason="needs moderngl")
    if shutil.which("node") is None:
        pytest.skip("needs node, which reads the shaders out of the page")
    benchmark = importlib.import_module("viewer_gpu")
    try:
        benchmark.create_context().release()
    except SystemExit as error:
        pytest.skip(str(error))

    shaders, job, file = (small_scene / name for name in ("shaders.json", "job.npz", "out.json"))
    given = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--sizes", "40x30,20x15"]
    run(benchmark, "--write-shaders", shaders)
    run(benchmark, *given, "--shaders", shaders, "--prepare", job)
    rounds = ["--rounds", "2", "--json", file]
    for scene in (given, [job]):
        out = run(benchmark, *scene, *rounds)
        results = written(small_scene)
        assert list(results["differences"]) == list(pages.WEBGL_FOOTPRINTS)
        for name, of_bits in results["differences"].items():
            assert f"| {name} " in out
            # Some devices cut half floats off where others round.
            assert of_bits["32-bit floats"]["largest"] <= 1 and of_bits["16-bit floats"]["largest"] <= 2
        count = len(pages.WEBGL_FOOTPRINTS)
        assert [row["size"] for row in results["rows"]] == ["40x30"] * count + ["20x15"] * count
        for row in results["rows"]:
            assert row["rounds"] == 2 and row["clock_ms"] > 0 and row["clock_ratio"] > 0
            assert len(row["ms"]) == 2 and all(len(view) == 2 for view in row["ms"])

    prepared = benchmark.Job.load(job)
    dataclasses.replace(prepared, expected=lambda _: prepared.expected("point")).save(job, ["analytic"])
    run(benchmark, job, *rounds, "--footprints", "analytic")
    assert written(small_scene)["differences"]["analytic"]["32-bit floats"]["largest"] > 1


def test_viewer_webgpu(small_scene, monkeypatch, run):
    """The page's passes in wgpu draw what the rasterizer does, also from a plan and a prepared file; other pictures are
    noticed."""
    pytest.importorskip("wgpu", reason="needs wgpu")
    if shutil.which("node") is None:
        pytest.skip("needs node, which records what the page does")
    benchmark = importlib.import_module("viewer_webgpu")
    monkeypatch.setattr(benchmark, "PAIRS", 1000)
    monkeypatch.setattr(benchmark, "WARM_UP", 0.0)
    try:
        benchmark.open_device({"buffers": [[16, 0]]})
    except SystemExit as error:
        pytest.skip(str(error))

    plan, job, file = (small_scene / name for name in ("plan.json", "job.npz", "out.json"))
    scene = [small_scene / "scene.npz", "--views", small_scene / "views.json", "--sizes", "40x30,20x15"]
    names = ["analytic", "moment:samples=4", "mip:variance=0.3"]
    options = ["--footprints", *names, "--timed", "moment:samples=4", "--rounds", "2", "--repeat", "2"]
    run(benchmark, *scene, *options, "--write-plan", plan)
    run(benchmark, *scene, *options, "--plan", plan, "--prepare", job)
    for given in ([*scene, "--plan", plan], [job]):
        out = run(benchmark, *given, *options, "--json", file)
        results = written(small_scene)
        assert list(results["differences"]) == names
        for name, found in results["differences"].items():
            assert f"  {name}: largest difference" in out
            assert found["largest"] <= 1 and found["changed"] == 0 and found["values"] == 2 * 3 * 40 * 30
        expected = [(size, "moment:samples=4") for size in ("40x30", "20x15")]
        assert [(row["size"], row["footprint"]) for row in results["rows"]] == expected
        for row in results["rows"]:
            assert row["clock"] > 0 and row["pairs"] > 0 and len(row["views"]) == 2

    prepared = benchmark.Job.load(job)
    dataclasses.replace(prepared, expected=lambda _: prepared.expected("mip:variance=0.3")).save(job, names)
    run(benchmark, job, *options, "--json", file)
    assert written(small_scene)["differences"]["analytic"]["largest"] > 1
    with pytest.raises(SystemExit, match="another number of Gaussians, other views or other sizes"):
        run(benchmark, *scene[:-1], "40x30", *options, "--plan", plan)
    with pytest.raises(SystemExit, match="has no point at 40x30"):
        run(benchmark, *scene, *options, "--plan", plan, "--footprints", "point")
