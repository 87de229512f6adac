"""Processes that tests start: quickly, since Python and torch are there before them.

Importing torch is most of what a short process does. These are forked from a server that has imported it and nothing
else; what they import besides, and what they read of their environment, is their own. So this module imports nothing
of the package.
"""

import multiprocessing
import os
import pathlib
import runpy
import subprocess
import sys
import tempfile
import textwrap
import time
import types
from multiprocessing import forkserver
from unittest import mock

TESTS = pathlib.Path(__file__).resolve().parent
DEADLINE = 900
"""Seconds after which something counts as hanging. Nothing takes a tenth of it on an idle machine: a busy one, which
gives a test a small part of its time, must not look like one that hangs."""
STARTED_WITH = dict(os.environ)


def start_processes(work, arguments, count):
    """Calls work(0, *arguments) ... work(count - 1, *arguments) in a process each and waits; fails where they hang."""
    import torch

    _start_server()
    context = torch.multiprocessing.start_processes(work, arguments, count, join=False, start_method="forkserver")
    end = time.monotonic() + 2 * DEADLINE
    try:
        while not context.join(timeout=max(end - time.monotonic(), 0.0)):
            assert time.monotonic() < end, "the processes hang"
    finally:
        for process in context.processes:
            if process.is_alive():
                process.kill()


def run_program(program, *arguments, environment=None, timeout=DEADLINE):
    """What a process of its own makes of a program, code or the path of a file, as subprocess.run says it."""
    _start_server()
    environment = dict(os.environ if environment is None else environment)
    with tempfile.TemporaryDirectory() as folder:
        made = [os.path.join(folder, name) for name in ("stdout", "stderr")]
        process = multiprocessing.get_context("forkserver").Process(
            target=_interpret, args=(program, [str(a) for a in arguments], environment, made)
        )
        process.start()
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(str(program), timeout)
        output = [pathlib.Path(path).read_text() if os.path.exists(path) else "" for path in made]
    return subprocess.CompletedProcess([program, *arguments], process.exitcode, *output)


def _start_server():
    """Whatever test is the first one: with the environment that all of them had."""
    forkserver.set_forkserver_preload(["torch"])
    with mock.patch.dict(os.environ, STARTED_WITH, clear=True):
        forkserver.ensure_running()


def _interpret(program, arguments, environment, output):
    """In the process: as if Python had been started with the program in the folder of the tests."""
    assert "analytic_rasterizer" not in sys.modules
    for stream, path in zip((1, 2), output):
        file = os.open(path, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, stream)
        os.close(file)
    sys.stdout, sys.stderr = (open(stream, "w", closefd=False) for stream in (1, 2))  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(TESTS)
    # What Python and OpenMP have read already.
    sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in environment
    if "OMP_NUM_THREADS" in environment:
        sys.modules["torch"].set_num_threads(int(environment["OMP_NUM_THREADS"]))
    is_file = isinstance(program, pathlib.Path)
    # Not in ROOT, whose package would come before the one that these tests were told to use.
    given = [os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    installed = [path for path in sys.path if path.startswith((sys.prefix, sys.base_prefix))]
    sys.path[:] = [str(program.parent) if is_file else "", *given, *installed]
    sys.argv[:] = [str(program) if is_file else "-c", *arguments]
    if is_file:
        runpy.run_path(str(program), run_name="__main__")
    else:
        sys.modules["__main__"] = types.ModuleType("__main__")
        exec(compile(textwrap.dedent(program), "<string>", "exec"), sys.modules["__main__"].__dict__)
