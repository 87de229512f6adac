"""The method `splatfacto-analytic`, within a stand-in for nerfstudio that does what ours relies on.

nerfstudio itself is tried by tests/with_nerfstudio.py, in an environment of its own.
"""

import re

import pytest
from places import ROOT
from processes import run_python

import analytic_rasterizer as ar

# How nerfstudio defines and finds methods: the table of methods is complete when entry points are loaded, and the
# module that has it is not. Its model calls the name `rasterization` of the model's module.
FILES = {
    "nerfstudio/__init__.py": "",
    "nerfstudio/models/__init__.py": "",
    "nerfstudio/plugins/__init__.py": "",
    "nerfstudio/configs/__init__.py": "",
    "nerfstudio/plugins/types.py": """
        from dataclasses import dataclass
        @dataclass
        class MethodSpecification:
            config: object
            description: str
    """,
    "nerfstudio/models/splatfacto.py": """
        from dataclasses import dataclass, field
        from gsplat.rendering import rasterization
        @dataclass
        class SplatfactoModelConfig:
            _target: type = field(default_factory=lambda: SplatfactoModel)
            refine_every: int = 100
            rasterize_mode: str = "classic"
        class SplatfactoModel:
            training, step = True, 0
            def __init__(self, config):
                self.config = config
            def get_training_callbacks(self, attributes):
                return ["theirs"]
            def get_outputs(self, camera):
                named = {"viewmats": camera[5], "Ks": camera[6], "width": 9, "height": 9}
                return rasterization(*camera[:5], **named, rasterize_mode=self.config.rasterize_mode)
    """,
    "nerfstudio/configs/method_configs.py": """
        from importlib.metadata import EntryPoint
        from types import SimpleNamespace
        from nerfstudio.models.splatfacto import SplatfactoModelConfig
        from nerfstudio.plugins.types import MethodSpecification
        model = SplatfactoModelConfig(refine_every=7)
        pipeline = SimpleNamespace(model=model)
        config = SimpleNamespace(method_name="splatfacto", pipeline=pipeline, optimizers={"means": 1})
        method_configs = {"splatfacto": config}
        spec = EntryPoint("splatfacto-analytic", ENTRY_POINT, "nerfstudio.method_configs").load()
        assert isinstance(spec, MethodSpecification)
        all_methods = method_configs | {spec.config.method_name: spec.config}
    """,
    "gsplat/__init__.py": "__version__ = '1.4.0'",
    "gsplat/rendering.py": """
        def rasterization(*args, **kwargs):
            return "theirs"
    """,
}
ENTRY_POINT = re.search(
    r'^\[project.entry-points."nerfstudio.method_configs"\]\nsplatfacto-analytic = (".+")$',
    (ROOT / "pyproject.toml").read_text(),
    re.M,
)[1]
SCENE = """
    import dataclasses, threading
    import torch
    K = torch.tensor([[9.0, 0, 4.5], [0, 9, 4.5], [0, 0, 1]])[None]
    means, scales = torch.tensor([[[0.3, 0, 3.0]], [[1.0, 0.1, 0.1]]])
    camera = means, torch.eye(4)[:1], scales, torch.ones(1), torch.ones(1, 3), torch.eye(4)[None], K
"""


@pytest.fixture
def run(tmp_path):
    """Runs code where the stand-in is installed; `changes` are other contents of its files."""

    def run(code, **changes):
        for name, text in {**FILES, **changes}.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("\n".join(line[8:] for line in text.split("\n")) if text.startswith("\n") else text)
        methods = tmp_path / "nerfstudio/configs/method_configs.py"
        methods.write_text(methods.read_text().replace("ENTRY_POINT", ENTRY_POINT))
        return run_python(f"    import sys; sys.path.insert(0, {str(tmp_path)!r})\n{SCENE}{code}")

    return run


def test_nerfstudio_finds_the_method(run):
    """With what splatfacto has, which stays as it is."""
    run("""
    from nerfstudio.configs.method_configs import all_methods
    ours, theirs = all_methods["splatfacto-analytic"], all_methods["splatfacto"]
    assert ours.method_name == "splatfacto-analytic" and theirs.method_name == "splatfacto"
    assert ours.optimizers == theirs.optimizers and ours.optimizers is not theirs.optimizers
    assert ours.pipeline.model.refine_every == 7
    assert type(theirs.pipeline.model).__name__ == "SplatfactoModelConfig"
    from analytic_rasterizer.dialects.gsplat import nerfstudio as ours_of_nerfstudio
    from analytic_rasterizer.footprints import RECOMMENDED
    assert type(ours.pipeline.model) is ours_of_nerfstudio.SplatfactoAnalyticModelConfig
    assert ours.pipeline.model._target is ours_of_nerfstudio.SplatfactoAnalyticModel
    assert ours.pipeline.model.footprint == RECOMMENDED
    """)


def test_the_method_can_be_asked_for_first(run):
    """Then it is ours that imports nerfstudio's table, which asks for ours."""
    run("""
    from analytic_rasterizer.dialects.gsplat import nerfstudio
    assert nerfstudio.method.config.method_name == "splatfacto-analytic"
    try:
        nerfstudio.methods
    except AttributeError as error:
        assert "has no attribute 'methods'" in str(error)
    else:
        raise AssertionError
    """)


def test_its_images_are_ours_and_those_of_splatfacto_are_not(run):
    """Also while ours is rendering in another thread."""
    run("""
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.models import splatfacto
    from analytic_rasterizer.dialects.gsplat import rasterization
    untouched = splatfacto.rasterization
    theirs = all_methods["splatfacto"].pipeline.model
    theirs = theirs._target(theirs)
    assert theirs.get_outputs(camera) == "theirs" and splatfacto.rasterization is untouched
    for footprint in ("point:dilation=0", "moment:samples=1"):
        config = dataclasses.replace(all_methods["splatfacto-analytic"].pipeline.model, footprint=footprint)
        images, alphas, meta = config._target(config).get_outputs(camera)
        expected, _, expected_meta = rasterization(*camera, 9, 9, footprint=footprint)
        assert torch.equal(images, expected) and images.max() > 0.1
        assert torch.equal(meta["radii"], expected_meta["radii"].amax(-1)), "one number, as gsplat 1.4 has"
        assert theirs.get_outputs(camera) == "theirs"

    class Camera(tuple):  # asks for theirs in another thread when it is read
        def __getitem__(self, index):
            thread = threading.Thread(target=lambda: found.append(theirs.get_outputs(camera)))
            thread.start()
            thread.join()
            return super().__getitem__(index)

    found = []
    assert config._target(config).get_outputs(Camera(camera))[0].shape == (1, 9, 9, 3)
    assert found == ["theirs"] * 3
    """)


def test_a_training_begins_with_the_cheaper_footprint(run):
    """Where it is asked for, until nine tenths of its steps. Evaluation has the other one."""
    run("""
    from types import SimpleNamespace
    from nerfstudio.configs.method_configs import all_methods
    from analytic_rasterizer.dialects.gsplat import rasterization
    named = {"footprint": "point:dilation=0", "first_footprint": "box:samples=1"}
    config = dataclasses.replace(all_methods["splatfacto-analytic"].pipeline.model, **named)
    cheap, dear = (rasterization(*camera, 9, 9, footprint=f)[0] for f in ("box:samples=1", "point:dilation=0"))
    assert not torch.equal(cheap, dear)
    model = config._target(config)
    assert torch.equal(model.get_outputs(camera)[0], dear)
    trainer = SimpleNamespace(config=SimpleNamespace(max_num_iterations=20))
    assert model.get_training_callbacks(SimpleNamespace(trainer=trainer)) == ["theirs"]
    for model.step, expected in ((0, cheap), (17, cheap), (18, dear), (19, dear)):
        assert torch.equal(model.get_outputs(camera)[0], expected), model.step
    model.step, model.training = 0, False
    assert torch.equal(model.get_outputs(camera)[0], dear)
    """)


def test_errors_come_before_a_model(run):
    printed = run("""
    from nerfstudio.configs.method_configs import all_methods
    config = all_methods["splatfacto-analytic"].pipeline.model
    for options in ({"footprint": "disc"}, {"rasterize_mode": "antialiased"}, {"footprint_from": 1.5}):
        try:
            dataclasses.replace(config, **options)
        except ValueError as error:
            print(error)
    """)
    first, second, third = printed.splitlines()
    assert "disc" in first and all(name in first for name in ar.FOOTPRINTS)
    assert second == (
        "rasterize_mode must be 'classic' with splatfacto-analytic, whose option is footprint, got 'antialiased'"
    )
    assert third == "footprint_from must be 0 to 1, got 1.5"


def test_a_splatfacto_that_calls_something_else_is_refused(run):
    """When a model is made: the other methods of such a nerfstudio work."""
    model = FILES["nerfstudio/models/splatfacto.py"].replace("import rasterization", "import rasterization as render")
    printed = run(
        """
    from nerfstudio.configs.method_configs import all_methods
    config = all_methods["splatfacto-analytic"].pipeline.model
    try:
        config._target(config)
    except ImportError as error:
        print(error)
    """,
        **{"nerfstudio/models/splatfacto.py": model},
    )
    assert printed.startswith("splatfacto-analytic needs a nerfstudio whose splatfacto calls gsplat's rasterization")


def test_the_package_does_not_import_it():
    run_python("""
    import sys
    import analytic_rasterizer.dialects.gsplat
    assert not [name for name in sys.modules if "nerfstudio" in name.split(".")]
    """)
