"""Meshes and shadows written to files or memory, and images read as targets. Images have a bounded size."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, did_you_mean
from ..inverse.shadow_art import target_images
from ..inverse.shadow_art.exports import vertex_colours
from ..io.files import atomic

if TYPE_CHECKING:
    from PIL import Image

#: Formats of meshes, with their media types.
FORMATS = {"ply": "application/octet-stream", "obj": "text/plain; charset=utf-8", "glb": "model/gltf-binary"}
#: Largest numbers of bytes and pixels of an image.
MOST_BYTES, MOST_PIXELS = 8_000_000, 16_000_000
# Other formats, such as vector graphics and documents, have large parsers that a server should not expose.
_IMAGES = ("PNG", "JPEG", "WEBP", "GIF", "BMP")

Array = npt.NDArray[np.float32]
Vertices = Array | npt.NDArray[np.float64]


def mesh_bytes(kind: str, vertices: Vertices, faces: npt.NDArray[np.uint32]) -> bytes:
    """A mesh of vertices (V, 3) and faces (F, 3) as a file of one of `FORMATS`. GLB files have vertex colours."""
    if kind not in FORMATS:
        raise ShadowmapError(f"no mesh format {kind!r}: choose from {', '.join(FORMATS)}.{did_you_mean(kind, FORMATS)}")
    import trimesh

    colours = vertex_colours(np.asarray(vertices, np.float32)) if kind == "glb" else None
    content = trimesh.Trimesh(vertices, faces, process=False, vertex_colors=colours).export(file_type=kind)
    return content.encode() if isinstance(content, str) else bytes(content)


def write_mesh(path: Path, vertices: Vertices, faces: npt.NDArray[np.uint32]) -> None:
    """Write a mesh in the format of the path's suffix. Other programs never see half of the file."""
    content = mesh_bytes(path.suffix.lower().removeprefix("."), vertices, faces)
    with atomic(path) as temporary:
        temporary.write_bytes(content)


def shadow_bytes(shadow: npt.NDArray[np.uint8]) -> bytes:
    """A shadow (H, W) as a grey PNG file. The value of a pixel is its visibility, as in `read_shadow`."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(shadow).save(buffer, format="PNG")
    return buffer.getvalue()


def write_shadow(path: Path, shadow: npt.NDArray[np.uint8]) -> None:
    """Write a shadow (H, W) as `shadow_bytes`. Other programs never see half of the file."""
    content = shadow_bytes(shadow)
    with atomic(path) as temporary:
        temporary.write_bytes(content)


def read_shadow(data: bytes, shape: tuple[int, int]) -> Array:
    """Read a painted shadow: visibility (H, W) from the grey values of an image of any size. Transparent pixels are lit.

    Raises ShadowmapError if the image is damaged or incomplete, too large, or of another aspect ratio.
    """
    image = _open(data)
    height, width = shape
    if abs(image.width * height - image.height * width) > 0.02 * image.height * width:
        raise ShadowmapError(f"an image of {image.width} x {image.height} pixels: the shadow has {width} x {height}.")
    ground = _on_white(image)
    if ground.size != (width, height):
        from PIL import Image

        ground = ground.resize((width, height), Image.Resampling.BOX if ground.width > width else Image.Resampling.BICUBIC)
    return np.divide(np.asarray(ground), 255, dtype=np.float32)


def read_target(data: bytes, seen: npt.NDArray[np.bool_]) -> Array:
    """Read a target (H, W) from any image.

    An opaque image of the canvas' size is read by `read_shadow`. Of any other image, the figure is enlarged to fill the canvas.

    Args:
        data: PNG, JPEG, WebP, GIF or BMP.
        seen: (H, W), pixels in which the view's camera sees the receiver.

    Raises ShadowmapError if the image cannot be read, is too large, or shows no figure.
    """
    height, width = seen.shape
    image = _open(data)
    if image.size == (width, height) and not _transparent(image):
        return read_shadow(data, (height, width))
    image.thumbnail((4 * width, 4 * height))
    figure = target_images.figure_of(np.asarray(image.convert("RGBA"), np.float32) / 255)
    return target_images.fit(figure, seen)


def _open(data: bytes) -> Image.Image:
    """Decode an image completely."""
    from PIL import Image

    if len(data) > MOST_BYTES:
        raise ShadowmapError(f"an image of {len(data)} bytes: {MOST_BYTES} are allowed.")
    try:
        image = Image.open(io.BytesIO(data), formats=_IMAGES)
        if image.width * image.height > MOST_PIXELS:  # before anything is decoded
            raise ShadowmapError(f"an image of {image.width} x {image.height} pixels: {MOST_PIXELS} are allowed.")
        image.load()
        return target_images.scaled_to_bytes(image)
    except ShadowmapError:
        raise
    except Exception as error:  # decoders raise errors of many types for damaged files
        raise ShadowmapError(f"no image, or a damaged one: give {', '.join(_IMAGES)}.") from error


def _transparent(image: Image.Image) -> bool:
    return bool(np.asarray(image.convert("RGBA"))[..., 3].min() < 255)


def _on_white(image: Image.Image) -> Image.Image:
    from PIL import Image

    coloured = image.convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", coloured.size, "white"), coloured).convert("L")
