"""Pose transfer between any two meshes with the weights that come with meshkit, or those of a run.

    python recipes/transfer.py identity.obj pose.obj -o out.obj
    python recipes/transfer.py identity.obj poses/ -o out.obj --weights runs/xdualnet

The same as the console script meshkit-transfer; --help lists the options, docs/transfer.md explains them.
"""

from meshkit._transfer_command import main

if __name__ == "__main__":
    main()
