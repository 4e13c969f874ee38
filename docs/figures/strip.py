"""A held-out view as each method reconstructs it, beside the truth and the error: the picture of the README.

    python docs/figures/strip.py SUBJECT CAMERA FRAME OUT.png NAME=RUN_DIR ...

SUBJECT is a folder, or studio. RUN_DIR is what `rsavatar run --out` wrote. The first tile is what a rolling-shutter
camera saw: the training camera nearest to the held-out one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from rsavatar.data.catalogue import open_subject

HEIGHT, GAIN = 420, 3.0


def tight(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Columns and rows of the body with a few pixels around it."""
    x, y, width, height = cv2.boundingRect(cv2.findNonZero(mask))
    return max(x - 6, 0), max(y - 4, 0), x + width + 6, y + height + 4


def tile(image: np.ndarray, box: tuple[int, int, int, int], caption: str) -> np.ndarray:
    """The box of an image, enlarged, with its caption under it."""
    x0, y0, x1, y1 = box
    cut = image[y0:y1, x0:x1]
    big = cv2.resize(cut, (round(cut.shape[1] * HEIGHT / cut.shape[0]), HEIGHT), interpolation=cv2.INTER_CUBIC)
    framed = cv2.copyMakeBorder(big, 0, 34, 3, 3, cv2.BORDER_CONSTANT)
    width = cv2.getTextSize(caption, cv2.FONT_HERSHEY_DUPLEX, 0.55, 1)[0][0]
    place = ((framed.shape[1] - width) // 2, HEIGHT + 22)
    return cv2.putText(framed, caption, place, cv2.FONT_HERSHEY_DUPLEX, 0.55, (230, 230, 230), 1, cv2.LINE_AA)


def main() -> None:
    """Read the arguments, write the strip."""
    root, camera, frame, out, *runs = sys.argv[1:]
    subject, n = open_subject(Path(root).name, None if root == "studio" else Path(root)), int(frame)
    truth, mask = subject.truth(camera, n)
    box = tight(mask)
    here = subject.cameras[camera].centre
    nearest = min(subject.training, key=lambda c: float(np.linalg.norm(subject.cameras[c].centre - here)))
    seen, seen_mask = subject.observe(nearest, n)
    seen_box = tight(seen_mask)
    tiles = [tile(seen, seen_box, "input")]
    for name, folder in (run.split("=", 1) for run in runs):
        image = cv2.imread(str(Path(folder) / "predictions" / camera / f"{n:06d}.png"))[..., ::-1]
        error = np.clip(np.abs(image.astype(float) - truth) * GAIN, 0, 255).astype(np.uint8)
        tiles += [tile(image, box, name), tile(error, box, f"error x{GAIN:g}")]
    tiles.append(tile(truth, box, "truth"))
    cv2.imwrite(out, np.hstack(tiles)[..., ::-1])


if __name__ == "__main__":
    main()
