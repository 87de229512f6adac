"""Processes that tests start: quickly, since Python and torch are there before them.

Importing torch is most of what a short process does. These are forked from a server that has imported it and nothing
else; what they import besides, and what they read of their environment, is their own. So this module imports nothing
of the package.
"""

import multiprocessing
import os
import pathlib
import pickle
import runpy
import site
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
import types
from multiprocessing import forkserver
from unittest import mock

from places import ROOT, TESTS

FOLDERS = sorted({str(path.parent) for path in TESTS.glob("*/*.py")})
"""Where code finds the tests and what they share."""
DEADLINE = 900
"""Seconds after which something counts as hanging. Nothing takes a tenth of it on an idle machine: a busy one, which
gives a test a small part of its time, must not look like one that hangs."""
STARTED_WITH = dict(os.environ)
_STARTING = threading.Lock()
"""Two threads that start the server: the environment that the second one sees must not be that of the first."""


def start_processes(work, arguments, count):
    """Calls work(0, *arguments) ... work(count - 1, *arguments) in a process each and waits; fails where they hang.

    They have the environment of this process. None of them is left, whatever happens.
    """
    import torch

    _start_server()
    # Taken apart when the process has its environment: the modules of `work` may look at it when they are imported.
    made = dict(os.environ), pickle.dumps((work, arguments))
    context = torch.multiprocessing.start_processes(_call, made, count, join=False, start_method="forkserver")
    end = time.monotonic() + 2 * DEADLINE
    try:
        while not context.join(timeout=max(end - time.monotonic(), 0.0)):
            assert time.monotonic() < end, "the processes hang"
    finally:
        _end(context.processes)


def run_program(program, *arguments, environment=None, timeout=DEADLINE):
    """What a process of its own makes of a program, code or the path of a file, as subprocess.run says it.

    Raises subprocess.TimeoutExpired where it takes longer; it is not left, whatever happens.
    """
    _start_server()
    environment = dict(os.environ if environment is None else environment)
    with tempfile.TemporaryDirectory() as folder:
        made = [os.path.join(folder, name) for name in ("stdout", "stderr")]
        process = multiprocessing.get_context("forkserver").Process(
            target=_interpret, args=(program, [str(a) for a in arguments], environment, made)
        )
        process.start()
        try:
            process.join(timeout)
            if process.exitcode is None:
                raise subprocess.TimeoutExpired(str(program), timeout)
        finally:
            _end([process])
        output = [pathlib.Path(path).read_text() if os.path.exists(path) else "" for path in made]
    return subprocess.CompletedProcess([program, *arguments], process.exitcode, *output)


def python_path():
    """PYTHONPATH of processes that find what the tests find, in whatever folder they run: their own path, and ROOT."""
    given = [os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    return os.pathsep.join([*given, str(ROOT)])


def run_python(code, *arguments, **environment):
    """Output of a process of its own that runs `code` among the tests; fails where it hangs."""
    done = run_program(code, *arguments, environment=os.environ | {"PYTHONPATH": python_path()} | environment)
    assert done.returncode == 0, (done.returncode, done.stderr[-4000:])
    return done.stdout


def in_threads(count, work):
    """Calls work(0) ... work(count - 1) side by side, waits for all, and raises what the first of them raised."""
    errors = [None] * count

    def guarded(i):
        try:
            work(i)
        except BaseException as error:  # also what pytest raises for `fail` and `skip`
            errors[i] = error

    threads = [threading.Thread(target=guarded, args=(i,)) for i in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for error in errors:
        if error is not None:
            raise error


def _start_server():
    """Whatever test is the first one: with the environment that all of them had."""
    forkserver.set_forkserver_preload(["torch"])
    with _STARTING, mock.patch.dict(os.environ, STARTED_WITH, clear=True):
        forkserver.ensure_running()


def _end(processes):
    """Kills what still runs, and waits until all of them are gone and write to no file any more."""
    for process in processes:
        if process.is_alive():
            process.kill()
    for process in processes:
        process.join()


def _call(index, environment, made):
    """In the process of start_processes."""
    _take_environment(environment)
    work, arguments = pickle.loads(made)
    work(index, *arguments)


def _interpret(program, arguments, environment, output):
    """In the process: as if Python had been started with the program in the folder of the tests."""
    assert "analytic_rasterizer" not in sys.modules
    for stream, path in zip((1, 2), output):
        file = os.open(path, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, stream)
        os.close(file)
    sys.stdout, sys.stderr = (open(stream, "w", closefd=False) for stream in (1, 2))  # noqa: SIM115
    _take_environment(environment)
    os.chdir(TESTS)
    is_file = isinstance(program, pathlib.Path)
    sys.path[:] = _search_path([str(program.parent)] if is_file else ["", *FOLDERS], environment)
    sys.argv[:] = [str(program) if is_file else "-c", *arguments]
    if is_file:
        runpy.run_path(str(program), run_name="__main__")
    else:
        sys.modules["__main__"] = types.ModuleType("__main__")
        exec(compile(textwrap.dedent(program), "<string>", "exec"), sys.modules["__main__"].__dict__)


def _take_environment(environment):
    """With what Python and OpenMP have read of theirs already."""
    os.environ.clear()
    os.environ.update(environment)
    sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in environment
    if "OMP_NUM_THREADS" in environment:
        sys.modules["torch"].set_num_threads(int(environment["OMP_NUM_THREADS"]))


def _search_path(own, environment):
    """sys.path of a program with folders of its own: without ROOT, whose package would come before the one that is to
    be tested."""
    given = [os.path.abspath(path) for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]
    prefixes = sys.prefix, sys.base_prefix, *([site.USER_SITE] if site.USER_SITE else [])
    folders = tuple(os.path.join(prefix, "") for prefix in prefixes)  # with a separator at the end
    project = str(TESTS.parent), str(TESTS), *FOLDERS  # which lie below a prefix where the project is in /usr/src

    def is_installed(path):
        return path not in project and os.path.join(path, "").startswith(folders)

    return [*own, *given, *filter(is_installed, sys.path)]
