"""Arrays and trees of arrays on Dr.Jit: memory, broadcasting, vectors, recordings. Knows no scenes."""
