"""Dr.Jit arrays and trees of arrays: memory, broadcasting, vectors, frozen functions. Independent of scenes."""
