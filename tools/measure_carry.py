"""How well a pose given to a simplified body is carried back to all of its vertices: the table in docs/io_viz.md.

The rig poses the simplified body through the skinning weights of the nearest points, and the full one for the truth.
Run with one thread: ``OMP_NUM_THREADS=1 python tools/measure_carry.py``.
"""

import time

import igl
import numpy as np
import torch

from meshkit.data import RiggedModel, load_humans
from meshkit.io import simplify

POSES = 30


def skinned(body: RiggedModel, verts: torch.Tensor, faces: torch.Tensor) -> RiggedModel:
    rest, rest_faces = body.template.double().numpy(), body.faces.numpy()
    _, face, foot = igl.point_mesh_squared_distance(verts.double().numpy(), rest, rest_faces)
    inner = igl.barycentric_coordinates(np.ascontiguousarray(foot), *(rest[rest_faces[face, k]] for k in range(3)))
    weights = torch.einsum("vk,vkj->vj", torch.tensor(inner).float(), body.weights[body.faces[face]]).clamp_min(0)
    still = torch.zeros(1, len(verts), 3), torch.zeros(1, body.num_joints, 3)
    return RiggedModel(verts, faces, still[0], body.joints, still[1], weights, body.parents, poses=body.poses)


def main() -> None:
    body = load_humans(6890)
    poses = np.random.default_rng(0).choice(len(body.poses), POSES, replace=False)
    for n in (1000, 2000):
        for method in ("libigl", "pymeshlab"):
            times = [time.process_time()]
            try:
                small = simplify(body.template, body.faces, n, method=method)
            except ImportError as error:
                print(f"{n} {method}: {error}")
                continue
            times.append(time.process_time())
            binding = small.binding
            times.append(time.process_time())
            coarse = skinned(body, small.verts, small.faces)
            errors, seconds = [], []
            for pose in torch.tensor(poses)[:, None]:
                posed, true = coarse(torch.zeros(1, 1), pose)[0], body(torch.zeros(1, 40), pose)[0]
                start = time.process_time()
                carried = binding.carry(posed)
                seconds.append(time.process_time() - start)
                error = 1000 * (carried - true).norm(dim=1)
                errors.append([error.mean(), error.quantile(0.99), error.max()])
            mean, most, worst = np.mean(errors, axis=0)
            print(
                f"{n} {method}: simplify {times[1] - times[0]:.2f} s, bind {times[2] - times[1]:.2f} s, "
                f"carry {np.mean(seconds):.3f} s; mm: mean {mean:.2f}, 99 % {most:.1f}, largest {worst:.1f}"
            )


if __name__ == "__main__":
    main()
