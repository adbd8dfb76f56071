"""What lies where, and what the hand holds: read from the contact forces every 0.2 s.

That is after every control step of an arm at 5 Hz and after every sixth at 30 Hz; grasps are read after each.

An object is placed on a receptacle when the hand, having carried it, has let go of it there, and at two readings
in a row it lies still, neither hand nor table touches it, and the receptacle carries at least half of its weight.
It stays placed for as long as the receptacle carries it. The reasons are in docs/design.md.
"""

import mujoco
import numpy as np

from lerobot_env_cronos.scene.model import TABLE, grasp_sensor, hand_sensor, support_sensor
from lerobot_env_cronos.scene.scenes import BODIES, Scene

GRASP_MIN_FORCE_N, GRASP_MAX_ANGLE_RAD = 0.5, np.deg2rad(85)
"""Grasp of the SimplerEnv Bridge tasks: force of each finger, and its angle to the closing axis."""
SQUEEZE_MAX_ANGLE_RAD = np.deg2rad(60)
"""Of what is carried: the fingers press on it from opposite sides, each within this angle of the closing axis. A
closed hand that hits an object, so that it jumps, may touch it with both fingers, too."""

CARRIES, CARRIES_NOTHING = 0.5, 0.05
"""Shares of an object's weight: what carries it, and what does not take part in carrying it."""

STILL_DISTANCE = 0.004
"""No point of an object that lies still moves further between two readings: 0.02 m/s. The speed at one moment
would not do: light objects may tremble in place [m]."""

RESTING_GAP = 0.001
"""Height above its resting pose up to which a body that was put there counts as lying on the table [m]."""

CARRY_READINGS = 3
"""Readings in a row that make a hold a carry; a push may wedge an object between the fingers for two."""

NOTHING, IN_HAND, ON_TABLE = -2, -1, 0
"""Where an object is: nowhere that counts, in the hand, on the table; on receptacle i of the scene is i + 1."""


class Judge:
    """Grasps and places of every object of n simulations, as of the last reading.

    Args:
        scene: names the objects and receptacles.
        model: the compiled scene.
        sensordata, qpos: live arrays (n, nsensordata) and (n, nq).

    Attributes:
        grasped: (n, objects) bool, both fingers press on the object.
        place: (n, objects) where the object was at the last reading: IN_HAND, squeezed and borne by nothing else;
            on what it lay, untouched by the hand; or NOTHING.
        pose: (n, objects, 7) its pose then.
        confirmed: (n, objects) where it was at the last two readings, and still if it lay; NOTHING if neither.
        rests: (n, objects) what it was last confirmed to lie on, for as long as that carries it, whether the hand
            touches it or not; else NOTHING.
        held: (n, objects) readings in a row, at most CARRY_READINGS, at which it was IN_HAND.
        carried_to: (n, objects) what bore the object first since the hand let go of it; IN_HAND since the hand has
            carried it at CARRY_READINGS readings; NOTHING when something else has borne it since.
    """

    STATE_FIELDS = ("grasped", "held", "carried_to", "place", "pose", "confirmed", "rests")
    SEEN_FIELDS = ("looks", "touched", "sum_up", "max_up", "max_share")

    def __init__(self, scene: Scene, model: mujoco.MjModel, sensordata: np.ndarray, qpos: np.ndarray):
        self.scene = scene
        self._sensordata, self._qpos = sensordata, qpos
        self._looks_per_reading = scene.robot.looks_per_reading
        self._is_read_each_step = scene.robot.steps_per_reading == 1
        objects = scene.objects
        supports = (TABLE, *scene.receptacles)

        def columns(name: str) -> np.ndarray:
            sensor = model.sensor(name)
            return np.arange(sensor.dim[0]) + sensor.adr[0]

        self._fingers = np.array([[columns(grasp_sensor(side, o)) for side in ("left", "right")] for o in objects])
        self._hand = np.array([columns(hand_sensor(o))[0] for o in objects])
        self._supports = np.array([[columns(support_sensor(o, s)) for s in supports] for o in objects])
        self._pose = np.array([model.joint(o).qposadr[0] + np.arange(7) for o in objects])
        self._weight = np.array([model.body(o).mass[0] for o in objects]) * np.linalg.norm(model.opt.gravity)
        self._height = np.array([BODIES[o].size[2] for o in objects])
        self._radius = np.array([np.linalg.norm(BODIES[o].size) / 2 for o in objects])
        shape = (len(sensordata), len(objects))
        self.grasped = np.zeros(shape, dtype=bool)
        self.carried_to = np.full(shape, IN_HAND, dtype=np.int8)
        self.held = np.zeros(shape, dtype=np.int8)
        # Since the last reading: looks, touches of the hand, shares of the weight that each support bore.
        self._looks, self._touched = np.zeros(len(sensordata), dtype=int), np.zeros(shape, dtype=bool)
        self._sum_up, self._max_up, self._max_share = (np.zeros((*shape, len(supports))) for _ in range(3))
        self.pose = qpos[:, self._pose]
        self.place, self.confirmed, self.rests = (np.full(shape, NOTHING, dtype=np.int8) for _ in range(3))

    def look(self, ids: np.ndarray) -> None:
        """Take in the contacts of simulations `ids` (k,) now, for the next reading; many times before it.

        What leans and trembles may be off the table at one moment.
        """
        touched, up, share = self._contacts(ids)
        self._looks[ids] += 1
        self._touched[ids] |= touched
        self._sum_up[ids] += up
        self._max_up[ids] = np.maximum(self._max_up[ids], up)
        self._max_share[ids] = np.maximum(self._max_share[ids], share)

    def is_due(self, ids: np.ndarray) -> np.ndarray:
        """Whether simulations `ids` (k,) are to be read after this control step, (k,) bool."""
        looks = self._looks[ids]
        return (looks == 0) | (looks >= self._looks_per_reading)

    def read_grasps(self, ids: np.ndarray, closing_axis: np.ndarray) -> None:
        """Read what simulations `ids` (k,) hold, and nothing else; see `read`."""
        self.grasped[ids], _ = self._read_grasps(self._sensordata[ids][:, self._fingers], closing_axis)

    def forget(self, ids: np.ndarray) -> None:
        """Forget what was looked at in simulations `ids`."""
        for name in self.SEEN_FIELDS:
            getattr(self, f"_{name}")[ids] = 0

    def _contacts(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Touched by the hand (k, objects), upward and whole force of each support (k, objects, supports) in
        weights of the object."""
        forces = self._sensordata[ids]
        supports = forces[:, self._supports] / self._weight[:, None, None]
        return forces[:, self._hand] > 0, supports[..., 2], np.linalg.norm(supports, axis=-1)

    def read(
        self, ids: np.ndarray, closing_axis: np.ndarray, *, settled: bool = False, stepped: bool = True
    ) -> None:
        """Read the contacts of simulations `ids` (k,), where that is due or after an intervention.

        Args:
            ids: the simulations.
            closing_axis: (k, 3) the direction in which the fingers close, world frame.
            settled: the bodies came to rest before: one reading counts as two.
            stepped: False where one body was put elsewhere without a control step: no other comes to rest by it,
                and no hold grows older.
        """
        unseen = ids[self._looks[ids] == 0]
        if len(unseen):
            self.look(unseen)
        grasped, squeezed = self._read_grasps(self._sensordata[ids][:, self._fingers], closing_axis)
        touched, up, share = self._contacts(ids)
        in_air = squeezed & (share <= CARRIES_NOTHING).all(-1)
        carrier = np.where(~touched & (up.max(-1) >= CARRIES), up.argmax(-1), NOTHING)

        alone = self._bears_alone(ids, carrier) & ~self._touched[ids]
        place = np.where(in_air, IN_HAND, np.where(alone, carrier, NOTHING))
        pose = self._qpos[ids][:, self._pose]
        same = (place == self.place[ids]) & (in_air | (self._distance(pose, self.pose[ids]) <= STILL_DISTANCE))
        same &= stepped | (place == self.confirmed[ids])
        confirmed = np.where(settled | same, place, NOTHING)

        # A hand that brushes past what was placed does not take it away.
        stays = np.where(~in_air & self._bears_alone(ids, self.rests[ids]), self.rests[ids], NOTHING)
        self.rests[ids] = np.where(confirmed >= ON_TABLE, confirmed, stays)

        carried_to = self.carried_to[ids]
        elsewhere = (carried_to != IN_HAND) & (carried_to != carrier)
        carried_to = np.where(carrier == NOTHING, carried_to, np.where(elsewhere, NOTHING, carrier))
        self.held[ids] = np.where(in_air, np.minimum(self.held[ids] + stepped, CARRY_READINGS), 0)
        self.carried_to[ids] = np.where(self.held[ids] == CARRY_READINGS, IN_HAND, carried_to)
        self.grasped[ids], self.confirmed[ids] = grasped, confirmed
        self.place[ids], self.pose[ids] = place, pose
        self.forget(ids)

    def _bears_alone(self, ids: np.ndarray, support: np.ndarray) -> np.ndarray:
        """Since the last reading `support` (k, objects) bore the object, on average, and no support of the other
        kind, table or receptacle, took part: (k, objects) bool; False where it is none."""
        mean_up = self._sum_up[ids] / self._looks[ids][:, None, None]
        borne = np.take_along_axis(mean_up, np.maximum(support, 0)[..., None], -1)[..., 0] >= CARRIES
        table_helps = self._max_share[ids][..., ON_TABLE] > CARRIES_NOTHING
        receptacle_helps = (self._max_up[ids][..., ON_TABLE + 1 :] > CARRIES_NOTHING).any(-1)
        return (support >= ON_TABLE) & borne & ~np.where(support == ON_TABLE, receptacle_helps, table_helps)

    def _read_grasps(self, forces: np.ndarray, closing_axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Grasps, and those that squeeze, (k, objects) each, from the fingers' forces (k, objects, 2, 3) [N]."""
        strength = np.linalg.norm(forces, axis=-1)
        along = np.einsum("kofd,kd->kof", forces, closing_axis)
        pressed = (strength >= GRASP_MIN_FORCE_N) & (np.abs(along) >= np.cos(GRASP_MAX_ANGLE_RAD) * strength)
        opposed = (along.prod(-1) < 0) & (np.abs(along) >= np.cos(SQUEEZE_MAX_ANGLE_RAD) * strength).all(-1)
        return pressed.all(-1), pressed.all(-1) & opposed

    def _distance(self, pose: np.ndarray, before: np.ndarray) -> np.ndarray:
        """What no point of an object moved further than between two poses (k, objects, 7): (k, objects) [m]."""
        cosine = np.minimum(np.abs((pose[..., 3:] * before[..., 3:]).sum(-1)), 1.0)
        return np.linalg.norm(pose[..., :3] - before[..., :3], axis=-1) + self._radius * 2 * np.arccos(cosine)

    def put(self, ids: np.ndarray, poses: np.ndarray) -> None:
        """Simulations `ids` (k,) were given poses (k, objects, 7): what was put counts as carried to where it is.

        Contacts only show after a step, so what was put into its resting pose on the table counts as lying there.
        """
        on_table = poses[..., 2] <= self._height / 2 + RESTING_GAP
        self.grasped[ids], self.held[ids] = False, 0
        self.carried_to[ids] = np.where(on_table, ON_TABLE, IN_HAND)
        self.pose[ids] = poses
        self.place[ids] = self.confirmed[ids] = self.rests[ids] = np.where(on_table, ON_TABLE, NOTHING)

    def put_one(self, ids: np.ndarray, body: str) -> None:
        """One body of simulations `ids` (k,) was moved by an intervention."""
        if body in self.scene.objects:
            self.carried_to[ids, self.scene.objects.index(body)] = IN_HAND

    def is_grasped(self, obj: str) -> np.ndarray:
        """Both fingers press on the object (n,): at least 0.5 N each, within 85 degrees of the closing axis."""
        return self.grasped[:, self.scene.objects.index(obj)].copy()

    def is_on(self, obj: str, receptacle: str) -> np.ndarray:
        """The object was carried to the receptacle, let go, came to rest on it, and has not left it (n,)."""
        i, place = self.scene.objects.index(obj), self.scene.receptacles.index(receptacle) + 1
        return (self.rests[:, i] == place) & (self.carried_to[:, i] == place)

    def is_on_table(self, obj: str) -> np.ndarray:
        """It was released, came to rest on the table, no receptacle carrying any of it, has not left it and
        is in no hand again (n,)."""
        i = self.scene.objects.index(obj)
        return (self.rests[:, i] == ON_TABLE) & ~self.grasped[:, i]

    def state_arrays(self) -> dict[str, np.ndarray]:
        """What the next reading depends on: live arrays with a leading dimension n."""
        arrays = {name: getattr(self, name) for name in self.STATE_FIELDS}
        if self._is_read_each_step:
            return arrays
        return arrays | {name: getattr(self, f"_{name}") for name in self.SEEN_FIELDS}
