"""Camera pass: visibility, points on surfaces, normals, shading edges, footprints of pixels."""
