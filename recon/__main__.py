"""The program: ``recon``, or ``python -m recon``."""

import sys


def main() -> None:
    """Run the program; a package that it cannot be loaded without is named in one line."""
    try:
        from recon.cli import main as run
    except ImportError as error:
        if (error.name or "").partition(".")[0] == "recon":
            raise
        sys.exit(f"error: a package cannot be imported ({error}); install recon again with pip")
    run()


if __name__ == "__main__":
    main()
