"""Random input for the library and its commands: each case ends in a right result or in one clear line."""
