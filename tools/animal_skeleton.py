"""The common skeleton of the shipped animals, and its joints in a mesh of 0 A.D. found from the bones of its rig.

Axes are the game's: x to the animal's left, y up, z backwards.
"""

import zipfile

import numpy as np
from make_animal_poses import RIGS
from zero_ad import read_mesh

# Per family: its meshes in the game, and the rig of each (see make_animal_poses).
FAMILIES = {
    "felidae": {"animal_lioness": "old", "animal_lion": "old", "tiger": "tiger"},
    "canidae": {"wolf": "wolf", "fox": "fox", "wolfhound": "wolfhound", "mastiff_no_spikes": "mastiff"},
    "equidae": {"horse": "horse", "pony": "horse", "horse_breed": "horse", "zebra": "zebra", "donkey": "old"},
    "bovidae": {
        "bull_a": "bovid",
        "zebu": "bovid",
        "sanga_cattle_a": "bovid",
        "wildebeest_adult": "bovid",
        "cattle_female_a": "bovid",
        "goat_male": "goat",
    },
    "cervid_giraffid_camelid": {"deer_mesh": "deer", "giraffe_adult": "giraffe", "camel": "camel"},
    "large": {"fauna_hippopotamus": "hippo", "rhino": "rhino", "bear": "bear", "bear_polar": "bear"},
}

NAMES = ["pelvis", "spine", "chest", "neck0", "neck1", "head", "nose", "tail0", "tail1", "tail2", "tailtip"]
PARENTS = [-1, 0, 1, 2, 3, 4, 5, 0, 7, 8, 9]
for _side in "LR":
    for _leg, _root in (("F", 2), ("H", 0)):
        PARENTS += [_root, *range(len(NAMES), len(NAMES) + 4)]
        NAMES += [f"{_leg}{part}.{_side}" for part in ("0", "1", "2", "3", "toe")]
LEGS = (11, 16, 21, 26)  # first joints of the legs: front left, hind left, front right, hind right
# A segment runs from a joint's parent to the joint and turns with the parent.
SEGMENTS = [(parent, joint) for joint, parent in enumerate(PARENTS) if parent >= 0]
_OTHER_SIDE = {"L": "R", "R": "L"}
MIRRORED = [NAMES.index(name[:-1] + _OTHER_SIDE[name[-1]] if "." in name else name) for name in NAMES]
FLIP = np.array([-1.0, 1.0, 1.0])


def load_animal(archive: zipfile.ZipFile, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) welded where the texture was cut, faces (F, 3), and places (B, 3) of the bones at rest."""
    mesh = read_mesh(archive, name)
    verts = mesh.verts.astype(np.float32)
    _, first, where = np.unique(np.round(verts / 1e-5).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    faces = where.ravel()[mesh.faces]
    a, b, c = faces.T
    return verts[first].astype(np.float64), faces[(a != b) & (b != c) & (a != c)], mesh.bones


def _spine(places: np.ndarray) -> np.ndarray:
    """Six joints in the plane of symmetry; where one bone stands for two joints, the later moves into the next gap."""
    spine = places.copy()
    for k in range(1, 6):
        if np.linalg.norm(spine[k] - spine[k - 1]) < 1e-6:
            if k == 1:
                spine[1] = 0.6 * spine[0] + 0.4 * spine[2]
            elif k < 5:
                spine[k] = 0.5 * (spine[k - 1] + spine[k + 1])
    spine[:, 0] = 0
    return spine


def _leg(bones: np.ndarray, leg: list[int]) -> np.ndarray:
    """Four joints; a bone named twice stands at its own place and then 55 % of the way to the next bone."""
    places = bones[leg].copy()
    for k in range(1, 3):
        if leg[k] == leg[k - 1]:
            places[k] = 0.45 * bones[leg[k]] + 0.55 * bones[leg[k + 1]]
    return places


def _nose(verts: np.ndarray, head: np.ndarray, height: float) -> np.ndarray:
    """The vertex farthest in front of the head and below it, horns left out."""
    near = (verts[:, 2] < head[2]) & (np.abs(verts[:, 0]) < 0.35 * height) & (verts[:, 1] < head[1] + 0.12 * height)
    front = verts[near]
    return front[np.argmax(-front[:, 2] - 0.3 * front[:, 1])]


def _tail(verts: np.ndarray, bones: np.ndarray, tail: list[int] | None, height: float) -> np.ndarray:
    """Three joints and the tip. Without bones: a short tail at the rearmost vertex of the upper half."""
    joints = np.empty((4, 3))
    if tail is None:
        upper = (np.abs(verts[:, 0]) < 0.12 * height) & (verts[:, 1] > verts[:, 1].min() + 0.5 * height)
        rear = verts[upper]
        joints[0] = rear[np.argmax(rear[:, 2])] - [0, 0, 0.05 * height]
        joints[1:] = joints[0] + np.outer([0.4, 0.8, 1.2], [0, -0.12 * height, 0.03 * height])
        return joints
    places = bones[tail]
    first, second = (np.linalg.norm(step) for step in np.diff(places, axis=0))
    joints[:3] = places
    joints[:3, 0] = 0
    if first >= 1e-6 and second >= 1e-6:
        joints[3] = joints[2] + 0.7 * (joints[2] - joints[1])
        return joints
    # Fewer than three bones: find the tip on the surface, along the direction of the bones there are.
    along = places[1] - places[0] if first > 1e-6 else np.array([0, -0.3, 0.2])
    length = np.linalg.norm(along)
    behind = verts[(np.abs(verts[:, 0]) < 0.05 * height) & (verts[:, 2] > joints[0, 2] - 0.02 * height)]
    tip = joints[0] + along / length * 1.6 * length
    if len(behind):
        reach = (behind - joints[0]) @ (along / length)
        tip = joints[0] + along / length * max(reach.max(), 1.4 * length)
        if reach.max() > 1.2 * first:
            tip = behind[np.argmax(reach)]
    if first > 1e-6:
        joints[1], joints[2], joints[3] = places[1], 0.5 * (places[1] + tip), tip
    else:
        joints[1:] = joints[0] + np.outer([1 / 3, 2 / 3, 1], tip - joints[0])
    return joints


def _toe(verts: np.ndarray, foot: np.ndarray, hips: float, height: float) -> np.ndarray:
    """The foremost low vertex near a foot, on the foot's side."""
    ground = verts[:, 1].min()
    low = verts[(verts[:, 1] < ground + 0.07 * height) & (verts[:, 0] * foot[0] > 0)]
    low = low[np.linalg.norm((low - foot)[:, [0, 2]], axis=1) < 0.25 * (hips - ground)]
    front = low[:, 2].min() if len(low) else foot[2] - 0.05 * height
    return np.array([foot[0], ground + 0.01 * height, front])


def find_joints(verts: np.ndarray, bones: np.ndarray, rig: str) -> np.ndarray:
    """The 31 joints (J, 3) of the common skeleton, symmetric, from the bones of a rig and the surface."""
    _, _, (spine, *legs), tail = RIGS[rig]
    height = float(np.ptp(verts[:, 1]))
    joints = np.zeros((len(NAMES), 3))
    joints[:6] = _spine(bones[spine])
    joints[6] = _nose(verts, joints[5], height)
    joints[7:11] = _tail(verts, bones, tail, height)
    joints[6:11, 0] = 0
    limbs = [_leg(bones, leg) for leg in legs]
    if limbs[0][:, 0].mean() < limbs[2][:, 0].mean():  # some rigs call left what lies at negative x
        limbs = [*limbs[2:], *limbs[:2]]
    for start, limb in zip(LEGS, limbs, strict=True):
        joints[start : start + 4] = limb
        joints[start + 4] = _toe(verts, limb[3], joints[0, 1], height)
    return 0.5 * (joints + joints[MIRRORED] * FLIP)
