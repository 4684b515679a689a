"""The processes that gather: who they are, how they begin, and that they end with the one they work for."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drnav_jax.dataset import job

SCRIPT = """
import os, sys, time
from drnav_jax.dataset import job
from test_workers import begun, identity

if __name__ == "__main__":
    with job._pool(begun, 2) as pool:
        found = list(pool.map(identity, [os.path.dirname(__file__)] * 2))
        print(*(pid for pid, _, _ in found), all(ready and deaf for _, ready, deaf in found), flush=True)
        time.sleep(60)
"""
ready = False


def begun():
    global ready
    ready = True


def identity(folder):
    """Of the process, once two of them have come to `folder`."""
    Path(folder, f"{os.getpid()}.here").touch()
    while len(list(Path(folder).glob("*.here"))) < 2:
        time.sleep(0.05)
    return os.getpid(), ready, signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_one_worker_is_no_process():
    with job._pool(begun, 1) as pool:
        assert pool.submit(os.getpid).result() == os.getpid()


@pytest.mark.long
def test_processes_are_prepared_and_do_not_outlive_a_kill(tmp_path):
    script = tmp_path / "gather.py"
    script.write_text(SCRIPT)
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    env = os.environ | {"PYTHONPATH": path}
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=env) as run:
        assert run.stdout is not None
        *pids, sound = run.stdout.readline().split()
        assert len(set(pids)) == 2 and str(run.pid) not in pids and sound == "True"
        assert all(alive(pid) for pid in pids)
        run.kill()
    until = time.monotonic() + 20
    while any(alive(pid) for pid in pids) and time.monotonic() < until:
        time.sleep(0.1)
    assert not any(alive(pid) for pid in pids)
