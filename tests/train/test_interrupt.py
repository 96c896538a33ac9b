"""Ctrl-C and SIGTERM: the first asks, the second ends the process, whatever the main thread is doing."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from train import interrupt
from train.interrupt import Interrupt

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("number", interrupt.SIGNALS)
def test_the_first_signal_only_asks(number, capfd):
    before = [signal.getsignal(each) for each in interrupt.SIGNALS]
    with Interrupt() as asked:
        assert asked.signal == 0
        signal.raise_signal(number)
        assert asked.signal == number
    assert [signal.getsignal(each) for each in interrupt.SIGNALS] == before
    assert signal.set_wakeup_fd(-1) == -1
    assert not any(thread.name == "signals" for thread in threading.enumerate())
    assert "again to stop at once" in capfd.readouterr().err


def test_the_second_signal_ends_with_its_own_code(monkeypatch):
    ended, wait = [], threading.Event()

    def end(*how):
        ended.append(how)
        wait.set()

    monkeypatch.setattr(interrupt, "_end", end)
    with Interrupt("farewell") as asked:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert wait.wait(10)
        assert asked.signal == signal.SIGINT
    assert ended == [(143, "farewell")]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_second_signal_does_not_wait_for_a_long_computation(number, code):
    # Like a compiled program this does not return to Python, where handlers run, for minutes.
    program = (
        "import hashlib\n"
        "from train.interrupt import Interrupt\n"
        "with Interrupt('continue with: this'):\n"
        "    print('ready', flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha256', b'', b'', 2_000_000_000)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    os.kill(process.pid, number)
    assert process.stderr.readline() == "\n"
    assert process.stderr.readline() == f"{interrupt.STOPPING}\n"
    os.kill(process.pid, number)
    _, said = process.communicate(timeout=10)
    assert process.returncode == code
    assert said == "\nstopped at once; continue with: this\n"
