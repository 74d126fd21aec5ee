"""Files: images, meshes, records, plots, tables for the terminal, and paths of the package's data. No rendering."""

from .files import atomic, check_output, read_arrays
from .images import colour_channels, read_exr, read_image, to_srgb, write_exr, write_image, write_png
from .records import read_json, read_record, write_json, write_record

__all__ = [
    "atomic",
    "check_output",
    "colour_channels",
    "read_arrays",
    "read_exr",
    "read_image",
    "read_json",
    "read_record",
    "to_srgb",
    "write_exr",
    "write_image",
    "write_json",
    "write_record",
    "write_png",
]
