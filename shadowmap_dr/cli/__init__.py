"""The command line program `shadowmap-dr`: one module for each command; `main` has them all."""
