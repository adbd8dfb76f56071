"""Materials and the textures generated for them."""

import mujoco
import numpy as np

COLOURS: dict[str, tuple[tuple[float, float, float], float, float]] = {
    # Material: colour, specular, shininess.
    "arm": ((0.13, 0.13, 0.145), 0.5, 0.35),
    "arm edge": ((0.23, 0.23, 0.25), 0.4, 0.3),
    "metal": ((0.72, 0.73, 0.75), 0.6, 0.5),
    "pad": ((0.42, 0.43, 0.46), 0.1, 0.1),
    "ketchup": ((0.86, 0.07, 0.05), 0.5, 0.6),
    "white plastic": ((0.96, 0.96, 0.94), 0.3, 0.5),
    "label": ((0.98, 0.86, 0.70), 0.1, 0.2),
    "blade": ((0.02, 0.58, 0.47), 0.4, 0.5),
    "handle": ((0.10, 0.24, 0.66), 0.4, 0.5),
    "yellow ceramic": ((1.0, 0.80, 0.04), 0.4, 0.6),
    "table edge": ((0.50, 0.43, 0.36), 0.1, 0.2),
    "table leg": ((0.86, 0.86, 0.85), 0.1, 0.2),
}

TABLE_TEXTURE_M = 0.45
CLOTH_TEXTURE_M = 0.11
FLOOR_TEXTURE_M = 1.2


def add_materials(spec: mujoco.MjSpec) -> None:
    """Add every material and texture that the visuals name."""
    for name, (rgb, specular, shininess) in COLOURS.items():
        spec.add_material(name=name, rgba=[*rgb, 1.0], specular=specular, shininess=shininess)
    _add_textured(spec, "table top", _oak(256), specular=0.12, shininess=0.3)
    _add_textured(spec, "cloth", _check(64), specular=0.0, shininess=0.0)
    _add_textured(spec, "floor", _tiles(128), specular=0.05, shininess=0.1)
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.94, 0.95], rgb2=[0.78, 0.80, 0.82], width=64, height=64,
    )  # fmt: skip


def _add_textured(spec: mujoco.MjSpec, name: str, image: np.ndarray, specular: float, shininess: float) -> None:
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=image.shape[1], height=image.shape[0], nchannel=3
    )
    texture.data = np.clip(image * 255, 0, 255).astype(np.uint8).tobytes()
    material = spec.add_material(name=name, specular=specular, shininess=shininess)
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, int], scale: tuple[float, float]) -> np.ndarray:
    """Periodic Gaussian noise (h, w) of unit variance with correlation lengths `scale` [pixels]."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    envelope = np.exp(-2 * np.pi**2 * ((fy * scale[0]) ** 2 + (fx * scale[1]) ** 2))
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * envelope, s=shape)
    return (noise - noise.mean()) / noise.std()


def _oak(n: int) -> np.ndarray:
    """Pale oak (n, n, 3), tileable: two boards with their grain along the image's vertical axis."""
    rng = np.random.default_rng(0)
    grain = 0.55 * _smooth_noise(rng, (n, n), (40, 1.2)) + 0.45 * _smooth_noise(rng, (n, n), (60, 6))
    board = np.where(np.arange(n) < n // 2, 0.02, -0.02)[None]
    seam = np.where(np.arange(n) % (n // 2) == 0, -0.10, 0.0)[None]
    return np.array([0.73, 0.66, 0.57]) * (1 + 0.035 * grain + board + seam)[..., None]


def _check(n: int) -> np.ndarray:
    """White and lilac gingham (n, n, 3) with a plain hem."""
    stripe = (np.arange(n) * 5 // n) % 2 == 0
    cover = (stripe[:, None] * 0.5 + stripe[None] * 0.5)[..., None]
    image = (1 - cover) * np.array([0.97, 0.96, 0.99]) + cover * np.array([0.44, 0.27, 0.72])
    return image


def _tiles(n: int) -> np.ndarray:
    """Pale floor tiles (n, n, 3) with slightly darker joints."""
    joint = (np.arange(n) % (n // 2)) < 2
    image = np.full((n, n, 3), 1.0) * np.array([0.84, 0.85, 0.85])
    image[joint] *= 0.93
    image[:, joint] *= 0.93
    return image
