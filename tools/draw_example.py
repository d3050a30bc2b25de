"""Run an example and save the figures it leaves, as NAME.png for those that have a name.

python tools/draw_example.py examples/plot_03_arap_handles.py docs/images arap_handles
"""

import runpy
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

script, folder, *wanted = sys.argv[1:]
sys.argv = [script]
runpy.run_path(script, run_name="__main__")
Path(folder).mkdir(parents=True, exist_ok=True)
for number in plt.get_fignums():
    figure = plt.figure(number)
    label = figure.get_label() or f"{Path(script).stem}_{number}"
    if not wanted or label in wanted:
        figure.savefig(Path(folder) / f"{label}.png", pil_kwargs={"optimize": True})
