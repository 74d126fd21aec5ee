"""What cameras see: visibility, points on surfaces, normals, shading edges, footprints of pixels."""
