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
    "fur": ((0.50, 0.28, 0.11), 0.05, 0.1),
    "light fur": ((0.90, 0.72, 0.47), 0.05, 0.1),
    "bead": ((0.06, 0.05, 0.05), 0.5, 0.6),
    "clear plastic": ((0.50, 0.82, 0.95), 0.7, 0.7),
    "bottle label": ((0.07, 0.25, 0.72), 0.2, 0.3),
    "oak": ((0.74, 0.67, 0.58), 0.1, 0.3),
    "light oak": ((0.77, 0.70, 0.605), 0.1, 0.3),
    "dark oak": ((0.71, 0.64, 0.55), 0.1, 0.3),
    "table edge": ((0.50, 0.43, 0.36), 0.1, 0.2),
    "wall": ((0.88, 0.90, 0.91), 0.0, 0.0),
}
"""Of every scene, used or not: the models of the first scenes stay what they were."""
MORE_COLOURS: dict[str, tuple[tuple[float, float, float], float, float]] = {
    "white print": ((0.93, 0.93, 0.91), 0.2, 0.3),
    "servo": ((0.09, 0.09, 0.10), 0.4, 0.4),
    "servo horn": ((0.20, 0.20, 0.22), 0.4, 0.4),
    "cardboard": ((0.70, 0.53, 0.35), 0.05, 0.1),
    "cardboard edge": ((0.56, 0.41, 0.26), 0.05, 0.1),
    "masking tape": ((0.90, 0.78, 0.50), 0.1, 0.2),
}
"""Added where they are used."""


def add_materials(spec: mujoco.MjSpec) -> None:
    """Add the materials and textures of `COLOURS`; `use_material` adds the others."""
    for name, look in COLOURS.items():
        _add_colour(spec, name, *look)
    for name, image in {"cloth": _gingham(64), "carpet": _rug(64), "newspaper": _front_page(64)}.items():
        _add_textured(spec, name, image)


def use_material(spec: mujoco.MjSpec, name: str) -> None:
    """Add a material of `MORE_COLOURS`, or the texture of a mat, unless it is there."""
    if spec.material(name) is not None:
        return
    if name == "mat":
        _add_textured(spec, name, _cutting_mat(64))
    else:
        _add_colour(spec, name, *MORE_COLOURS[name])


def _add_colour(
    spec: mujoco.MjSpec, name: str, rgb: tuple[float, float, float], specular: float, shininess: float
) -> None:
    spec.add_material(name=name, rgba=[*rgb, 1.0], specular=specular, shininess=shininess)


def add_plain_material(spec: mujoco.MjSpec, name: str, colour: tuple[float, float, float]) -> None:
    """Add an untextured material of a body's own colour (RGB, 0 to 1)."""
    spec.add_material(name=name, rgba=[*colour, 1.0], specular=0.2, shininess=0.3)


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


def _cutting_mat(n: int) -> np.ndarray:
    """A dark green mat (n, n, 3) with a pale grid of eight cells."""
    green, line = np.array([0.09, 0.30, 0.25]), np.array([0.45, 0.65, 0.55])
    on_line = np.arange(n) % (n // 8) == n // 16
    return np.where((on_line[:, None] | on_line[None])[..., None], line, green)


def _rug(n: int) -> np.ndarray:
    """A crimson rug (n, n, 3) with a navy and cream border and a diamond in the middle."""
    crimson, navy, cream = np.array([[0.62, 0.06, 0.10], [0.10, 0.12, 0.34], [0.94, 0.85, 0.66]])
    x = np.abs((np.arange(n) + 0.5) / n * 2 - 1)
    edge, diamond = np.maximum(x[:, None], x[None]), x[:, None] + x[None]
    image = np.broadcast_to(crimson, (n, n, 3)).copy()
    image[diamond < 0.62] = cream
    image[diamond < 0.44] = navy
    image[edge > 0.74] = cream
    image[edge > 0.84] = navy
    return image


def _front_page(n: int) -> np.ndarray:
    """The folded front page of a newspaper (n, n, 3), read from the front: columns run along the y axis."""
    paper, ink, grey = np.array([0.93, 0.92, 0.88]), np.array([0.10, 0.10, 0.12]), np.array([0.50, 0.50, 0.52])
    page = np.broadcast_to(paper, (n, n, 3)).copy()  # (from top to bottom, from left to right)
    row, column = np.arange(n)[:, None] / n, np.arange(n)[None] / n
    inside = (column > 0.06) & (column < 0.94)
    page[(row > 0.08) & (row < 0.25) & inside & (column * 9 % 1 < 0.8)] = ink
    page[(row > 0.31) & (row < 0.34) & inside] = ink
    page[(row > 0.41) & (row < 0.94) & (np.arange(n)[:, None] % 8 < 4) & inside & (column * 3.4 % 1 < 0.86)] = grey
    page[(row > 0.43) & (row < 0.78) & (column > 0.52) & (column < 0.94)] = [0.42, 0.46, 0.55]
    return page.transpose(1, 0, 2)
