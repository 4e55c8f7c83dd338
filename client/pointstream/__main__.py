"""``python -m pointstream`` is the command."""

from .command import main

main()
