"""Ctrl-C and SIGTERM: the first asks the training to stop after its update, the second ends it at once."""

import os
import signal
import socket
import sys
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
STOPPING = "stopping after this update; again to stop at once"


def exit_code(number: int) -> int:
    """Exit code of a process that a signal ended, as shells give it: 130 for Ctrl-C, 143 for SIGTERM."""
    return 128 + number


class Interrupt:
    """Listens while the training runs; `signal` is the first signal's number, 0 before it.

    Python runs its handlers between two bytecodes only, so not during an update or while compiling, which
    can take minutes. The second signal therefore ends the process from a thread. That loses nothing but
    the updates since the last checkpoint: files are written whole or not at all.
    """

    def __init__(self, farewell: str = "") -> None:
        """`farewell` is said when the process ends at once."""
        self.signal = 0
        self.farewell = farewell

    def __enter__(self) -> "Interrupt":
        """Listens for the signals."""
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._handlers = {number: signal.signal(number, self._ask) for number in SIGNALS}
        self._wakeup = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._watch, name="signals", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Restores what listened before."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._writer.close()
        self._thread.join()
        self._reader.close()

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.signal = self.signal or number

    def _watch(self) -> None:
        """Reads a byte for each signal as it arrives, whatever the main thread is doing."""
        seen = 0
        while received := self._reader.recv(1):
            if received[0] not in SIGNALS:
                continue
            seen += 1
            if seen == 1:
                _say(STOPPING)
            else:
                _end(exit_code(received[0]), self.farewell)


def _end(code: int, farewell: str) -> None:
    show_cursor = "\x1b[?25h" if sys.stdout.isatty() else ""  # hidden by the progress bar
    _say(f"{show_cursor}stopped at once; {farewell}")
    os._exit(code)


def _say(line: str) -> None:
    try:
        os.write(2, f"\n{line}\n".encode())
    except OSError:  # nobody listens any more
        return
