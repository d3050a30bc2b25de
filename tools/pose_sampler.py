"""Human poses: anatomical joint angles around a library of archetypes, within joint limits, without crossing limbs.

A pose is a local rotation per bone in world-aligned axes (x to the body's left, y backwards, z up), so that the same
rotations give the same pose on every identity. Angles are in degrees.
"""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

X, Y, Z = np.eye(3)
FRONT = -Y

# Rows: hip flexion, hip abduction, hip outward rotation, knee flexion, ankle. Columns: left, right.
LEGS = {
    "stand": [(0, 0), (6, 6), (5, 5), (2, 2), (0, 0)],
    "wide": [(0, 0), (22, 22), (8, 8), (2, 2), (0, 0)],
    "walk": [(28, -18), (4, 4), (2, 2), (8, 18), (5, -8)],
    "walk2": [(15, -8), (4, 4), (2, 2), (35, 5), (5, 0)],
    "run": [(70, -22), (4, 4), (0, 0), (80, 55), (10, -20)],
    "lunge": [(85, -15), (8, 8), (2, 2), (85, 20), (10, -20)],
    "squat": [(95, 95), (22, 22), (18, 18), (110, 110), (22, 22)],
    "sit": [(88, 88), (8, 8), (3, 3), (88, 88), (0, 0)],
    "kick": [(75, -5), (6, 8), (0, 5), (12, 8), (-10, 0)],
    "kneeup": [(95, 0), (6, 6), (5, 5), (100, 2), (-10, 0)],
    "sidekick": [(10, 0), (55, 4), (10, 5), (10, 5), (0, 0)],
    "onleg": [(30, 0), (25, 2), (45, 5), (110, 4), (-10, 0)],
    "split": [(45, -25), (6, 6), (0, 0), (5, 5), (-15, -20)],
    "kneel": [(85, 0), (8, 6), (0, 0), (90, 95), (0, -30)],
}
# Rows: elevation (-90 down, 90 up), azimuth (0 sideways, 90 forwards), elbow flexion, inward twist, pronation.
ARMS = {
    "down": [(-75, -75), (25, 25), (20, 20), (0, 0), (0, 0)],
    "apose": [(-45, -45), (10, 10), (12, 12), (0, 0), (0, 0)],
    "tpose": [(0, 0), (5, 5), (5, 5), (0, 0), (0, 0)],
    "up": [(65, 65), (25, 25), (15, 15), (0, 0), (0, 0)],
    "vee": [(35, 35), (15, 15), (10, 10), (0, 0), (0, 0)],
    "front": [(-5, -5), (75, 75), (12, 12), (0, 0), (0, 0)],
    "walk": [(-65, -65), (75, -45), (30, 15), (0, 0), (0, 0)],
    "run": [(-55, -60), (70, -50), (90, 85), (0, 0), (0, 0)],
    "box": [(-35, -40), (60, 60), (110, 120), (0, 0), (20, 20)],
    "punch": [(0, -50), (80, 40), (8, 110), (0, 0), (30, 20)],
    "oneup": [(70, -75), (30, 20), (10, 15), (0, 0), (0, 0)],
    "point": [(5, -75), (70, 20), (5, 15), (0, 0), (0, 0)],
    "hips": [(-50, -50), (-25, -25), (75, 75), (-35, -35), (30, 30)],
    "shrug": [(-55, -55), (20, 20), (70, 70), (45, 45), (-40, -40)],
    "phone": [(-45, -75), (40, 20), (135, 15), (0, 0), (0, 0)],
    "throw": [(15, 10), (-10, 70), (85, 30), (55, 0), (0, 0)],
    "back": [(-55, -55), (-45, -45), (20, 20), (0, 0), (0, 0)],
}
# Flexion, side bend, twist of the whole spine.
SPINES = {
    "none": (0, 0, 0),
    "lean": (22, 0, 0),
    "bow": (55, 0, 0),
    "arch": (-14, 0, 0),
    "side": (0, 22, 0),
    "twist": (4, 0, 32),
    "twistb": (4, 0, -32),
    "sideb": (0, -22, 0),
}
# Whole-body poses that belong together; other poses mix legs, arms and spine at random.
COMBINATIONS = [
    ("stand", "down", "none"), ("stand", "apose", "none"), ("stand", "tpose", "none"), ("walk", "walk", "none"),
    ("walk2", "walk", "twist"), ("run", "run", "lean"), ("squat", "front", "lean"), ("sit", "down", "none"),
    ("sit", "shrug", "lean"), ("kick", "box", "none"), ("lunge", "punch", "lean"), ("wide", "vee", "none"),
    ("wide", "up", "arch"), ("stand", "front", "bow"), ("kneeup", "run", "lean"), ("onleg", "up", "none"),
    ("wide", "hips", "none"), ("stand", "phone", "none"), ("split", "throw", "twistb"), ("kneel", "point", "none"),
    ("sidekick", "tpose", "side"), ("wide", "throw", "twist"), ("kneel", "down", "lean"), ("stand", "oneup", "sideb"),
]  # fmt: skip
# Standard deviation around the archetype, then the limits of the joint.
LEG_JOINTS = [(7, -30, 120), (4, -12, 60), (6, -35, 50), (7, 0, 140), (5, -40, 28)]
ELEVATION, AZIMUTH, ELBOW, ARM_TWIST, PRONATION = (8, -82, 80), (9, -55, 115), (9, 0, 145), (8, -60, 70), (12, -60, 70)
INCOHERENT = 0.35  # share of poses that mix legs, arms and spine at random
SPINE_SHARES = {"spine05": 0.15, "spine04": 0.2, "spine03": 0.2, "spine02": 0.25, "spine01": 0.2}
NECK_SHARES = {"neck01": 0.2, "neck02": 0.2, "neck03": 0.2, "head": 0.4}
FINGER_SHARES = {1: 0.9, 2: 1.0, 3: 0.6}

# (part, first bone, last bone, radius in metres) of the limbs' capsules, once per side, and of the trunk's.
LIMB_CAPSULES = [
    ("upperarm", "upperarm01", "lowerarm01", 0.045),
    ("forearm", "lowerarm01", "wrist", 0.038),
    ("hand", "wrist", "finger3-2", 0.035),
    ("thigh", "upperleg01", "lowerleg01", 0.075),
    ("shin", "lowerleg01", "foot", 0.05),
]
TRUNK_CAPSULES = [
    ("pelvis", "spine05", "spine02", 0.115),
    ("chest", "spine02", "spine01", 0.125),
    ("neck", "neck01", "head", 0.06),
]
HEAD_RADIUS = 0.085
ARM_PARTS, LEG_PARTS = {"upperarm", "forearm", "hand"}, {"thigh", "shin"}
ALLOWED_OVERLAP = 0.9  # of the sum of the radii


class Capsule(NamedTuple):
    part: str
    side: str
    radius: float


class Arm(NamedTuple):
    """Directions of one arm in the reference pose."""

    upper: np.ndarray
    fore: np.ndarray
    hinge: np.ndarray
    reference_flexion: float
    across: np.ndarray
    palm: np.ndarray
    curl: np.ndarray


def turn(axis: np.ndarray, degrees: float) -> np.ndarray:
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def turn_onto(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Smallest rotation that takes one unit vector to another."""
    axis = np.cross(source, target)
    sine = np.linalg.norm(axis)
    return np.eye(3) if sine < 1e-8 else turn(axis, np.degrees(np.arctan2(sine, source @ target)))


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def may_collide(a: Capsule, b: Capsule) -> bool:
    """Whether an overlap of two capsules is a fault: neighbours along the skeleton always overlap a little."""
    parts, one_side = {a.part, b.part}, a.side == b.side != ""
    if not parts & (ARM_PARTS | LEG_PARTS) or parts == {"thigh"} or parts == {"thigh", "pelvis"}:
        return False
    if one_side and parts <= ARM_PARTS:
        return parts == {"hand", "upperarm"}
    if one_side and parts <= LEG_PARTS:
        return False
    return not ("upperarm" in parts and parts & {"pelvis", "chest", "neck"})


class PoseSampler:
    """Draws poses for an ``anny`` model; the same seed gives the same poses."""

    def __init__(self, model: Any, seed: int) -> None:
        self.model = model
        self.rng = np.random.default_rng(seed)
        self.index = {label: i for i, label in enumerate(model.bone_labels)}
        self.arms = {side: self._measure_arm(side) for side in "LR"}

    def sample(self, count: int) -> tuple[np.ndarray, list[str]]:
        """Local rotations (count, bones, 3, 3) and a ``legs/arms/spine`` tag per pose."""
        poses: list[np.ndarray] = []
        tags: list[str] = []
        while len(poses) < count:
            drawn = [self._draw() for _ in range(64)]
            free = self._is_free(np.stack([pose for pose, _ in drawn]))
            poses += [pose for (pose, _), ok in zip(drawn, free, strict=True) if ok]
            tags += [tag for (_, tag), ok in zip(drawn, free, strict=True) if ok]
        return np.stack(poses[:count]), tags[:count]

    def _joints(self, rotations: np.ndarray) -> np.ndarray:
        """Joint positions (P, bones, 3) of the mean adult body in the given poses."""
        pose = torch.eye(4).repeat(*rotations.shape[:2], 1, 1)
        pose[..., :3, :3] = torch.from_numpy(rotations)
        body = {
            label: torch.full((len(pose),), 0.67 if label == "age" else 0.5) for label in self.model.phenotype_labels
        }
        with torch.no_grad():
            return self.model(pose_parameters=pose, phenotype_kwargs=body)["bone_poses"][:, :, :3, 3].double().numpy()

    def _measure_arm(self, side: str) -> Arm:
        if not hasattr(self, "reference"):
            self.reference = self._joints(np.tile(np.eye(3), (1, len(self.index), 1, 1)))[0]
        head = {name: self.reference[i] for name, i in self.index.items()}
        upper = unit(head[f"lowerarm01.{side}"] - head[f"upperarm01.{side}"])
        fore = unit(head[f"wrist.{side}"] - head[f"lowerarm01.{side}"])
        middle = unit(head[f"finger3-1.{side}"] - head[f"wrist.{side}"])
        across = unit(head[f"finger5-1.{side}"] - head[f"finger2-1.{side}"])  # index to little finger
        palm = unit(np.cross(middle, across)) * (1 if side == "L" else -1)
        # Fingers curl towards the palm, which looks inwards and down in the reference pose.
        inwards = np.array([-upper[0], 0.0, -0.2])
        curl = across if np.cross(across, middle) @ inwards > 0 else -across
        flexion = float(np.degrees(np.arccos(upper @ fore)))
        return Arm(upper, fore, unit(np.cross(upper, fore)), flexion, across, palm, curl)

    def _near(self, angle: float, spread: float, low: float = -np.inf, high: float = np.inf) -> float:
        return float(np.clip(angle + self.rng.normal() * spread, low, high))

    def _draw(self) -> tuple[np.ndarray, str]:
        rng = self.rng
        if rng.random() < INCOHERENT:
            leg, arm, spine = rng.choice(list(LEGS)), rng.choice(list(ARMS)), rng.choice(list(SPINES))
        else:
            leg, arm, spine = COMBINATIONS[rng.integers(len(COMBINATIONS))]
        legs, arms, back = np.array(LEGS[leg], float), np.array(ARMS[arm], float), np.array(SPINES[spine], float)
        if rng.random() < 0.3:  # another right arm
            arms[:, 1] = np.array(ARMS[rng.choice(list(ARMS))], float)[:, 1]
        if rng.random() < 0.3:  # legs on the way to another archetype
            share = rng.random() * 0.5
            legs = (1 - share) * legs + share * np.array(LEGS[rng.choice(list(LEGS))], float)
        if rng.random() < 0.5:  # mirrored
            legs, arms, back = legs[:, ::-1], arms[:, ::-1], back * [1, -1, -1]

        turns: dict[str, np.ndarray] = {}
        for column, side in enumerate("LR"):
            turns |= self._leg(side, legs[:, column])
            turns |= self._arm(side, arms[:, column])
            turns |= self._fingers(side)
        turns |= self._trunk(back)
        rotations = np.tile(np.eye(3), (len(self.index), 1, 1))
        for label, rotation in turns.items():
            rotations[self.index[label]] = rotation
        # A deep bow turns the pelvis too, and the legs stay where they are.
        if self.flexion > 30:
            rotations[self.index["root"]] = rotations[self.index["root"]] @ turn(X, 0.4 * self.flexion)
            for side in "LR":
                thigh = self.index[f"upperleg01.{side}"]
                rotations[thigh] = turn(X, -0.4 * self.flexion) @ rotations[thigh]
        return rotations, f"{leg}/{arm}/{spine}"

    def _leg(self, side: str, angles: np.ndarray) -> dict[str, np.ndarray]:
        out = 1.0 if side == "L" else -1.0
        flexion, abduction, rotation, knee, ankle = (
            self._near(angle, *joint) for angle, joint in zip(angles, LEG_JOINTS, strict=True)
        )
        half = turn(Z, out * rotation * 0.5)
        return {
            # The reference pose already stands with the legs 6 degrees apart.
            f"upperleg01.{side}": turn(X, -flexion) @ turn(Y, -out * (abduction - 6)) @ half,
            f"upperleg02.{side}": half,
            f"lowerleg01.{side}": turn(X, knee),
            f"foot.{side}": turn(X, ankle),
        }

    def _arm(self, side: str, angles: np.ndarray) -> dict[str, np.ndarray]:
        arm, out = self.arms[side], 1.0 if side == "L" else -1.0
        elevation, azimuth = self._near(angles[0], *ELEVATION), self._near(angles[1], *AZIMUTH)
        rise, swing = np.radians(elevation), np.radians(azimuth)
        target = np.array([out * np.cos(rise) * np.cos(swing), -np.cos(rise) * np.sin(swing), np.sin(rise)])
        clavicle = turn(Y, -out * np.clip((elevation + 20) * 0.28, -4, 25))  # the shoulder girdle takes its share
        local = clavicle.T @ target
        aim = turn_onto(arm.upper, local)
        # Twist the arm about itself so that the elbow folds forwards or, when the arm points there, upwards.
        hinge = aim @ arm.hinge
        wanted = clavicle.T @ unit(np.cross(target, FRONT if abs(target[1]) < 0.9 else Z))
        wanted = unit(wanted - (wanted @ local) * local)
        settle = np.degrees(np.arctan2(np.cross(hinge, wanted) @ local, hinge @ wanted))
        twist = np.clip(settle, -55, 55) + out * self._near(angles[3], *ARM_TWIST)
        elbow = self._near(angles[2], *ELBOW) - arm.reference_flexion
        pronation = out * self._near(angles[4], *PRONATION)
        bend, tilt = self.rng.normal() * 12, self.rng.normal() * 6
        return {
            f"clavicle.{side}": clavicle,
            f"upperarm01.{side}": turn(local, 0.5 * twist) @ aim,
            f"upperarm02.{side}": turn(arm.upper, 0.5 * twist),
            f"lowerarm01.{side}": turn(arm.hinge, elbow),
            f"lowerarm02.{side}": turn(arm.fore, 0.6 * pronation),
            f"wrist.{side}": turn(arm.fore, 0.4 * pronation) @ turn(arm.across, bend) @ turn(arm.palm, tilt),
        }

    def _fingers(self, side: str) -> dict[str, np.ndarray]:
        curl = abs(self.rng.normal()) * 22 + (45 if self.rng.random() < 0.2 else 0)
        turns = {}
        for finger in "2345":
            angle = np.clip(curl + self.rng.normal() * 6, -8, 75)
            for joint, share in FINGER_SHARES.items():
                turns[f"finger{finger}-{joint}.{side}"] = turn(self.arms[side].curl, angle * share)
        return turns

    def _trunk(self, angles: np.ndarray) -> dict[str, np.ndarray]:
        self.flexion = flexion = self._near(angles[0], 5)
        bend, twist = self._near(angles[1], 4), self._near(angles[2], 5)
        # The head keeps looking ahead, in part.
        nod, sway, look = self._near(-0.25 * flexion, 9), self._near(-0.3 * bend, 6), self._near(-0.3 * twist, 18)
        turns = {b: turn(Z, twist * s) @ turn(X, flexion * s) @ turn(Y, bend * s) for b, s in SPINE_SHARES.items()}
        turns |= {b: turn(Z, look * s) @ turn(X, nod * s) @ turn(Y, sway * s) for b, s in NECK_SHARES.items()}
        return turns | {"root": turn(Z, self._near(0, 15, -40, 40))}

    def _is_free(self, rotations: np.ndarray) -> np.ndarray:
        """(P,) whether no limb capsule of the mean body runs into another."""
        joints = self._joints(rotations)
        head = {name: joints[:, i] for name, i in self.index.items()}
        capsules, ends = [], []
        for side in "LR":
            for part, first, last, radius in LIMB_CAPSULES:
                capsules.append(Capsule(part, side, radius))
                ends.append((head[f"{first}.{side}"], head[f"{last}.{side}"]))
        for part, first, last, radius in TRUNK_CAPSULES:
            capsules.append(Capsule(part, "", radius))
            ends.append((head[first], head[last]))
        capsules.append(Capsule("skull", "", HEAD_RADIUS))
        ends.append((head["head"], head["head"] + 2.2 * (head["head"] - head["neck03"])))
        along = np.linspace(0, 1, 7)[:, None]
        points = [first[:, None] + (last - first)[:, None] * along for first, last in ends]
        free = np.ones(len(joints), dtype=bool)
        for i, j in combinations(range(len(capsules)), 2):
            if may_collide(capsules[i], capsules[j]):
                gap = np.linalg.norm(points[i][:, :, None] - points[j][:, None], axis=-1).min((1, 2))
                free &= gap > ALLOWED_OVERLAP * (capsules[i].radius + capsules[j].radius)
        return free
