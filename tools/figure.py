"""The README's figure of a run: render beside frame, and the trajectory over time.

python tools/figure.py RUN SCENE/groundtruth.txt FRAME OUTPUT.png
"""

import sys
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from ebarf_ns.evaluation.trajectory_error import aligned_positions
from ebarf_ns.geometry.trajectory_file import read_tum


def main(run: Path, groundtruth: Path, frame: str, output: Path) -> None:
    """Draw and save."""
    picture = cv2.imread(str(run / "renders" / f"{frame}.png"))
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 3.2), width_ratios=[2.4, 1])
    left.imshow(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
    left.axis("off")
    truth = read_tum(groundtruth)
    for name, label, colour in (("initial", "given", "tab:blue"), ("refined", "refined", "tab:orange")):
        estimate = read_tum(run / f"trajectory_{name}.txt")
        position = aligned_positions(estimate, truth)
        seconds = estimate.t_us[estimate.t_us <= truth.t_us[-1]].numpy() * 1e-6
        for axis in range(3):
            line = right.plot(seconds, 100 * (position[:, axis] - truth.poses.position[0, axis].item()), color=colour)
            line[0].set_label(label if axis == 0 else "")
    for axis in range(3):
        line = right.plot(
            truth.t_us.numpy() * 1e-6,
            100 * (truth.poses.position[:, axis] - truth.poses.position[0, axis]).numpy(),
            "--",
            color="tab:green",
        )
        line[0].set_label("true" if axis == 0 else "")
    right.set(xlabel="time [s]", ylabel="x, y, z [cm]")
    right.legend(fontsize=8)
    figure.tight_layout(pad=0.3)
    figure.savefig(output, dpi=80)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], Path(sys.argv[4]))
