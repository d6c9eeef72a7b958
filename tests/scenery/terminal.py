"""A terminal of 80 columns: what a command shows in it, and when.

``python -m tests.scenery.terminal recon export …`` says how long a command was silent.
"""

import fcntl
import os
import pty
import re
import select
import struct
import sys
import termios
import time
from itertools import pairwise
from typing import NamedTuple

COLUMNS = 80
_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Shown(NamedTuple):
    """What was shown: seconds since the start and text, of all that was written; and how it ended.

    Lines are as they were drawn, each drawing of a live line by itself.
    """

    code: int
    seconds: float
    written: list[tuple[float, str]]

    @property
    def lines(self) -> list[str]:
        whole = "".join(text for _, text in self.written)
        return [line.rstrip() for line in re.split(r"[\r\n]+", _ESCAPE.sub("", whole)) if line]

    @property
    def longest_silence_s(self) -> float:
        """Until the first word, between two, or after the last one."""
        at = [0.0, *(s for s, text in self.written if _ESCAPE.sub("", text).strip()), self.seconds]
        return max(b - a for a, b in pairwise(at))


def show(*words: str, **environment: str) -> Shown:
    """Run ``recon`` with these words in a terminal."""
    command = [sys.executable, "-m", "recon", *words]
    start = time.monotonic()
    child, terminal = pty.fork()
    if child == 0:
        os.environ.update(environment, TERM="xterm")
        os.execv(command[0], command)  # noqa: S606 - this program
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    written = []
    while True:
        select.select([terminal], [], [])
        try:
            data = os.read(terminal, 1 << 16)
        except OSError:  # how a terminal says that nobody writes any more
            break
        written.append((time.monotonic() - start, data.decode(errors="replace")))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return Shown(code, time.monotonic() - start, written)


if __name__ == "__main__":
    shown = show(*sys.argv[2:])
    first, silence = shown.written[0][0], shown.longest_silence_s
    text = f"first word {first:.1f} s, longest silence {silence:.1f} s of {shown.seconds:.1f} s"
    sys.stdout.write(f"{text}\n")
