"""The command ``python -m docs.tables``."""

from . import main

main()
