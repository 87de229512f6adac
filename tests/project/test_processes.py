"""The processes that tests start, whichever way these end."""

import os
import signal
import site
import subprocess
import sys
import time

import processes
import pytest
import torch
from places import ROOT, TESTS
from processes import in_threads, run_program, start_processes

ASKED = os.environ.get("ANALYTIC_RASTERIZER_ASKED")  # when this module is imported


def write_environment(rank, folder):
    text = f"{ASKED} {os.environ['ANALYTIC_RASTERIZER_ASKED']} {torch.get_num_threads()}"
    (folder / str(rank)).write_text(text)


def fail_while_others_wait(rank, folder):
    # Written beside the folder: a file in it has its content from the beginning, whenever this process is killed.
    beside = folder.parent / f"{folder.name}-{rank}"
    beside.write_text(str(os.getpid()))
    os.replace(beside, folder / str(rank))
    if rank > 0:
        time.sleep(600)
    while len(list(folder.iterdir())) < 2:
        time.sleep(0.01)
    raise ValueError("as asked")


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_processes_have_the_environment_of_the_one_that_starts_them(tmp_path, monkeypatch):
    """Also while their modules are imported."""
    monkeypatch.setenv("ANALYTIC_RASTERIZER_ASKED", "yes")
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    start_processes(write_environment, (tmp_path,), 2)
    assert [(tmp_path / rank).read_text() for rank in "01"] == ["yes yes 3"] * 2


def test_no_process_is_left_where_one_fails(tmp_path):
    with pytest.raises(torch.multiprocessing.ProcessRaisedException, match="as asked"):
        start_processes(fail_while_others_wait, (tmp_path,), 2)
    pids = [int((tmp_path / rank).read_text()) for rank in "01"]
    assert not any(map(is_running, pids))


def test_no_process_is_left_where_a_program_hangs(monkeypatch):
    end, ended = processes._end, []

    def end_and_note(given):
        end(given)
        ended.extend(given)

    monkeypatch.setattr(processes, "_end", end_and_note)
    with pytest.raises(subprocess.TimeoutExpired):
        run_program("import time; time.sleep(600)", timeout=0.01)
    assert [process.exitcode for process in ended] == [-signal.SIGKILL]


def test_a_program_finds_what_is_installed_for_the_user_and_not_this_project(tmp_path, monkeypatch):
    user, standard = str(tmp_path / "user"), os.path.dirname(os.__file__)
    monkeypatch.setattr(site, "USER_SITE", user)
    monkeypatch.setattr(sys, "path", [str(TESTS), str(ROOT), standard, user])
    found = processes._search_path(["here"], {"PYTHONPATH": str(tmp_path / "given")})
    assert found == ["here", str(tmp_path / "given"), standard, user]


def test_a_program_does_not_find_what_only_begins_like_a_prefix_or_is_the_project(monkeypatch):
    """Also where the project lies below a prefix, as /usr/src does below that of Debian's Python."""
    root, standard = ROOT, os.path.dirname(os.__file__)
    monkeypatch.setattr(sys, "prefix", str(root.parent))
    like_it = f"{root.parent}-old"
    project = [str(root / "tests" / "makers"), str(root / "tests"), str(root)]
    monkeypatch.setattr(sys, "path", [*project, like_it, str(root.parent), standard])
    assert processes._search_path(["here"], {}) == ["here", str(root.parent), standard]


def test_what_a_thread_raises_is_raised_when_all_have_ended():
    ended = []

    def work(i):
        ended.append(i)
        if i != 1:
            raise ValueError(f"in thread {i}")

    with pytest.raises(ValueError, match="in thread 0"):
        in_threads(3, work)
    assert sorted(ended) == [0, 1, 2]


def test_threads_that_start_processes_leave_the_environment_as_it_is(monkeypatch):
    monkeypatch.setenv("ANALYTIC_RASTERIZER_ASKED", "yes")
    in_threads(8, lambda _: [processes._start_server() for _ in range(50)])
    assert os.environ["ANALYTIC_RASTERIZER_ASKED"] == "yes"
