"""The command line, `gyromodel` or `python -m gyromodel`: Ctrl-C ends it in one sentence from the first moment on."""

import os
import signal
import sys

# Exit status after Ctrl-C, as of typer and shells.
INTERRUPTED = 130


def main() -> None:
    """Load the commands, which takes a while, and run one."""
    try:
        from gyromodel.cli import main as run

        run()
    except KeyboardInterrupt:
        print("gyromodel: interrupted; no file is half written, and batch goes on where it was", file=sys.stderr)
        # Python itself would end by the signal, and another status, where that came within an eval.
        os._exit(INTERRUPTED)
    finally:
        # All is written and said; Python takes a while to end.
        signal.signal(signal.SIGINT, signal.SIG_IGN)


if __name__ == "__main__":
    main()
