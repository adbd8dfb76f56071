"""Materials. Large surfaces are untextured: in software a texture doubles the cost of every pixel it covers."""

import mujoco
import numpy as np

COLOURS: dict[str, tuple[tuple[float, float, float], float, float]] = {
    # Material: colour, specular, shininess.
    "arm": ((0.16, 0.16, 0.175), 0.6, 0.35),
    "arm edge": ((0.29, 0.29, 0.315), 0.4, 0.3),
    "metal": ((0.72, 0.73, 0.75), 0.6, 0.5),
    "pad": ((0.42, 0.43, 0.46), 0.1, 0.1),
    "ketchup": ((0.86, 0.07, 0.05), 0.5, 0.6),
    "white plastic": ((0.96, 0.96, 0.94), 0.3, 0.5),
    "label": ((0.98, 0.86, 0.70), 0.1, 0.2),
    "blade": ((0.02, 0.58, 0.47), 0.4, 0.5),
    "handle": ((0.10, 0.24, 0.66), 0.4, 0.5),
    "yellow ceramic": ((1.0, 0.78, 0.02), 0.4, 0.6),
    "yellow glaze": ((1.0, 0.88, 0.28), 0.4, 0.6),
    "oak": ((0.74, 0.67, 0.58), 0.1, 0.3),
    "light oak": ((0.77, 0.70, 0.605), 0.1, 0.3),
    "dark oak": ((0.71, 0.64, 0.55), 0.1, 0.3),
    "table edge": ((0.50, 0.43, 0.36), 0.1, 0.2),
    "wall": ((0.88, 0.90, 0.91), 0.0, 0.0),
}


def add_materials(spec: mujoco.MjSpec) -> None:
    """Add every material and texture that the visuals name."""
    for name, (rgb, specular, shininess) in COLOURS.items():
        spec.add_material(name=name, rgba=[*rgb, 1.0], specular=specular, shininess=shininess)
    _add_textured(spec, "cloth", _gingham(64))


def _add_textured(spec: mujoco.MjSpec, name: str, image: np.ndarray) -> None:
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=image.shape[1], height=image.shape[0], nchannel=3
    )
    texture.data = np.clip(image * 255, 0, 255).astype(np.uint8).tobytes()
    material = spec.add_material(name=name, specular=0.0, shininess=0.0)
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name


def _gingham(n: int) -> np.ndarray:
    """White and lilac checks (n, n, 3), five stripes each way."""
    stripe = (np.arange(n) * 5 // n) % 2 == 0
    cover = (stripe[:, None] * 0.5 + stripe[None] * 0.5)[..., None]
    return (1 - cover) * np.array([0.97, 0.96, 0.99]) + cover * np.array([0.44, 0.27, 0.72])
