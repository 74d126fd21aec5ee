"""A recorded function that looks a texture up under a mask ends the process, on a GPU."""

import drjit as dr
from drjit.cuda.ad import Float, Texture1f, UInt32

texture = Texture1f([2], 1, True)
texture.set_value(Float(1, 3))


@dr.freeze
def look_up(texture: Texture1f, u: Float) -> Float:
    return texture.eval(u, u > 0.5)[0]


for _ in range(2):
    found = look_up(texture, (dr.arange(UInt32, 64) + 0.5) / 64)
print("right" if found[0] == 0 and found[63] == 3 else "wrong")
