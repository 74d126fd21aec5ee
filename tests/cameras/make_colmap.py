"""Writes `colmap/`: a small reconstruction as COLMAP itself writes it, and places that COLMAP finds for its points.

pip install pycolmap && python tests/cameras/make_colmap.py
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap

FOLDER = Path(__file__).parent / "colmap"
LENSES = {
    "SIMPLE_PINHOLE": [600, 320, 240],
    "PINHOLE": [610, 590, 312.5, 247.25],
    "SIMPLE_RADIAL": [600, 320, 240, -0.08],
    "RADIAL": [600, 320, 240, -0.1, 0.02],
    "OPENCV": [610, 590, 312.5, 247.25, -0.1, 0.02, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [410, 390, 312.5, 247.25, 0.02, -0.01, 3e-3, -1e-3],
    "FULL_OPENCV": [610, 590, 312.5, 247.25, -0.1, 0.02, 1e-3, -2e-3, 5e-3, 0.01, -2e-3, 1e-3],
    "SIMPLE_RADIAL_FISHEYE": [400, 320, 240, 0.03],
    "RADIAL_FISHEYE": [400, 320, 240, 0.03, -0.01],
}


def main() -> None:
    random = np.random.default_rng(5)
    points = random.uniform(-0.8, 0.8, (20, 3))
    made, places = pycolmap.Reconstruction(), {}
    for number, (model, parameters) in enumerate(LENSES.items(), start=1):
        lens = pycolmap.Camera.create_from_model_name(number, model, 600.0, 640, 480)
        lens.params = parameters
        made.add_camera_with_trivial_rig(lens)
        turn = random.normal(size=4)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn / np.linalg.norm(turn)), random.normal(size=3) * 0.3 + [0, 0, 4])
        name = f"folder {number}/photo of {model}.jpg"
        picture = pycolmap.Image(name=name, camera_id=number, image_id=number)
        # An image with points and one without any: an empty line in the text file.
        if number % 2:
            picture.points2D = [pycolmap.Point2D(random.uniform(0, 400, 2)) for _ in range(number)]
        made.add_image_with_trivial_frame(picture, pose)
        seen = points @ pose.rotation.matrix().T + pose.translation
        places[name] = [lens.img_from_cam(point).tolist() for point in seen]
    for kind, write in (("binary", made.write_binary), ("text", made.write_text)):
        folder = FOLDER / kind
        folder.mkdir(parents=True, exist_ok=True)
        write(str(folder))
        for file in folder.iterdir():
            if file.stem not in ("cameras", "images"):
                file.unlink()
    (FOLDER / "places.json").write_text(json.dumps({"points": points.tolist(), "places": places}) + "\n")


if __name__ == "__main__":
    main()
