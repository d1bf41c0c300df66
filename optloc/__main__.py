"""Entry point of ``python -m optloc``."""

from optloc.cli.application import main

if __name__ == "__main__":
    main()
