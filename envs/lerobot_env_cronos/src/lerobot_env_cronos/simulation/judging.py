"""What lies where, and what the hand holds: read from the contact forces once after every control step.

An object is placed on a receptacle when the hand, having carried it, has let go of it there, and now at two
readings in a row it lies still, neither hand nor table touches it, and the receptacle carries at least half of its
weight. The reasons are in docs/protocol.md.
"""

import mujoco
import numpy as np

from lerobot_env_cronos.scene.model import TABLE, grasp_sensor, hand_sensor, support_sensor
from lerobot_env_cronos.scene.scenes import BODIES, Scene

GRASP_MIN_FORCE_N, GRASP_MAX_ANGLE_RAD = 0.5, np.deg2rad(85)
"""Grasp of the SimplerEnv Bridge tasks: force of each finger, and its angle to the closing axis."""

CARRIES, CARRIES_NOTHING = 0.5, 0.05
"""Shares of an object's weight: what carries it, and what does not take part in carrying it."""

STILL_SPEED = 0.02
"""Speed that no point of an object at rest exceeds [m/s]."""

RESTING_GAP = 0.001
"""Height above its resting pose up to which a body that was put there counts as lying on the table [m]."""

NOTHING, IN_HAND, ON_TABLE = -2, -1, 0
"""Where an object is: nowhere that counts, in the hand, on the table; on receptacle i of the scene is i + 1."""


class Judge:
    """Grasps and places of every object of n simulations, as of the last reading.

    Args:
        scene: names the objects and receptacles.
        model: the compiled scene.
        sensordata, qvel: live arrays (n, nsensordata) and (n, nv).

    Attributes:
        grasped: (n, objects) bool, both fingers press on the object.
        place: (n, objects) where the object was at the last reading: IN_HAND, grasped and borne by nothing else;
            on what it lay still, untouched by the hand; or NOTHING.
        confirmed: (n, objects) where it was at the last two readings, NOTHING if that differs.
        carried_to: (n, objects) what bore the object first since the hand let go of it; IN_HAND since the hand has
            carried it at two readings; NOTHING when something else has borne it since.
    """

    STATE_FIELDS = ("grasped", "carried_to", "place", "confirmed")

    def __init__(self, scene: Scene, model: mujoco.MjModel, sensordata: np.ndarray, qvel: np.ndarray):
        self.scene = scene
        self._sensordata, self._qvel = sensordata, qvel
        objects = scene.objects
        supports = (TABLE, *scene.receptacles)

        def columns(name: str) -> np.ndarray:
            sensor = model.sensor(name)
            return np.arange(sensor.dim[0]) + sensor.adr[0]

        self._fingers = np.array([[columns(grasp_sensor(side, o)) for side in ("left", "right")] for o in objects])
        self._hand = np.array([columns(hand_sensor(o))[0] for o in objects])
        self._supports = np.array([[columns(support_sensor(o, s)) for s in supports] for o in objects])
        self._velocity = np.array([model.joint(o).dofadr[0] + np.arange(6) for o in objects])
        self._weight = np.array([model.body(o).mass[0] for o in objects]) * np.linalg.norm(model.opt.gravity)
        self._height = np.array([BODIES[o].size[2] for o in objects])
        self._radius = np.array([np.linalg.norm(BODIES[o].size) / 2 for o in objects])
        shape = (len(sensordata), len(objects))
        self.grasped = np.zeros(shape, dtype=bool)
        self.carried_to = np.full(shape, IN_HAND, dtype=np.int8)
        self.place, self.confirmed = (np.full(shape, NOTHING, dtype=np.int8) for _ in range(2))

    def read(self, ids: np.ndarray, closing_axis: np.ndarray, *, settled: bool = False) -> None:
        """Read the contacts of simulations `ids` (k,), after a control step or an intervention.

        Args:
            ids: the simulations.
            closing_axis: (k, 3) the direction in which the fingers close, world frame.
            settled: the bodies came to rest before: one reading counts as two.
        """
        forces = self._sensordata[ids]
        grasped = self._read_grasps(forces[:, self._fingers], closing_axis)
        touched = forces[:, self._hand] > 0
        supports = forces[:, self._supports] / self._weight[:, None, None]
        up, share = supports[..., 2], np.linalg.norm(supports, axis=-1)

        in_air = grasped & (share <= CARRIES_NOTHING).all(-1)
        carrier = np.where(~touched & (up.max(-1) >= CARRIES), up.argmax(-1), NOTHING)
        table_helps = share[..., ON_TABLE] > CARRIES_NOTHING
        receptacle_helps = (up[..., ON_TABLE + 1 :] > CARRIES_NOTHING).any(-1)
        alone = ~np.where(carrier == ON_TABLE, receptacle_helps, table_helps)
        place = np.where(alone & self._is_still(ids), carrier, NOTHING)
        place = np.where(in_air, IN_HAND, place)
        confirmed = np.where(settled | (place == self.place[ids]), place, NOTHING)

        carried_to = self.carried_to[ids]
        elsewhere = (carried_to != IN_HAND) & (carried_to != carrier)
        carried_to = np.where(carrier == NOTHING, carried_to, np.where(elsewhere, NOTHING, carrier))
        self.carried_to[ids] = np.where(confirmed == IN_HAND, IN_HAND, carried_to)
        self.grasped[ids], self.place[ids], self.confirmed[ids] = grasped, place, confirmed

    def _read_grasps(self, forces: np.ndarray, closing_axis: np.ndarray) -> np.ndarray:
        """Grasps (k, objects) from the fingers' forces (k, objects, 2, 3) [N]."""
        strength = np.linalg.norm(forces, axis=-1)
        along = np.abs(np.einsum("kofd,kd->kof", forces, closing_axis))
        pressed = (strength >= GRASP_MIN_FORCE_N) & (along >= np.cos(GRASP_MAX_ANGLE_RAD) * strength)
        return pressed.all(-1)

    def _is_still(self, ids: np.ndarray) -> np.ndarray:
        velocity = self._qvel[ids][:, self._velocity]
        linear, angular = np.linalg.norm(velocity[..., :3], axis=-1), np.linalg.norm(velocity[..., 3:], axis=-1)
        return linear + self._radius * angular < STILL_SPEED

    def put(self, ids: np.ndarray, poses: np.ndarray) -> None:
        """Simulations `ids` (k,) were given poses (k, objects, 7): what was put counts as carried to where it is.

        Contacts only show after a step, so what was put into its resting pose on the table counts as lying there.
        """
        on_table = poses[..., 2] <= self._height / 2 + RESTING_GAP
        self.grasped[ids], self.carried_to[ids] = False, np.where(on_table, ON_TABLE, IN_HAND)
        self.place[ids] = self.confirmed[ids] = np.where(on_table, ON_TABLE, NOTHING)

    def put_one(self, ids: np.ndarray, body: str) -> None:
        """One body of simulations `ids` (k,) was moved by an intervention."""
        if body in self.scene.objects:
            self.carried_to[ids, self.scene.objects.index(body)] = IN_HAND

    def is_grasped(self, obj: str) -> np.ndarray:
        """Both fingers press on the object (n,): at least 0.5 N each, within 85 degrees of the closing axis."""
        return self.grasped[:, self.scene.objects.index(obj)].copy()

    def is_on(self, obj: str, receptacle: str) -> np.ndarray:
        """The object was carried to the receptacle, let go, and rests on it (n,)."""
        i, place = self.scene.objects.index(obj), self.scene.receptacles.index(receptacle) + 1
        return (self.confirmed[:, i] == place) & (self.carried_to[:, i] == place)

    def is_on_table(self, obj: str) -> np.ndarray:
        """The object is released and rests on the table, no receptacle carrying any of it (n,)."""
        return self.confirmed[:, self.scene.objects.index(obj)] == ON_TABLE

    def get_state(self) -> dict[str, np.ndarray]:
        """What the next reading depends on, as arrays with a leading dimension n."""
        return {name: getattr(self, name).copy() for name in self.STATE_FIELDS}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a state taken by `get_state`."""
        for name in self.STATE_FIELDS:
            getattr(self, name)[:] = state[name]
