"""pip install, which says what it compiles: "[3/14] csrc/cpu/kernels_avx2.cpp".

    python wheels/install.py --editable ".[test]"

prints these lines and messages of setup.py as they come, and all that pip says if it fails.
"""

import re
import subprocess
import sys

SHOWN = re.compile(r"\s*(\[\d+/\d+\] |analytic_rasterizer: )")


def run(command: list[str]) -> int:
    """The exit status of a command, of whose output the lines are printed that `SHOWN` matches, or all if it fails."""
    said = []
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as process:
        for line in process.stdout:
            said.append(line)
            if SHOWN.match(line):
                print(line.strip(), flush=True)
    if process.returncode:
        print(*said, sep="", end="", flush=True)
    return process.returncode


if __name__ == "__main__":
    sys.exit(run([sys.executable, "-m", "pip", "install", "--verbose", *sys.argv[1:]]))
