#!/usr/bin/env python
"""Train the network of the fine matcher, on rendered pairs and on Middlebury scenes of before 2014.

    pip install torch
    scripts/train_features.py PHOTOGRAPHS MIDDLEBURY --minutes 60 --into features.npz
    scripts/train_features.py PHOTOGRAPHS MIDDLEBURY --start features.npz --into better.npz

Half of the samples are rendered: planes that hide each other, each with a photograph or with noise
on it. PHOTOGRAPHS is a folder of pictures of any kind (the network that comes with the program saw
the pictures of Debian's packages gnome-backgrounds, lomiri-wallpapers, mate-backgrounds,
plasma-workspace-wallpapers and ukui-wallpapers). The others are of MIDDLEBURY's 2003, 2005 and 2006
at a third of their size (it saw Cones, Books, Dolls, Aloe, Baby1 and Cloth1; Art is left out, as
MiddEval3 has it too). Gain, gamma, contrast, light, blur, noise and height of the two views differ.

Each view is described by itself. The loss is the cross entropy of the softmax, over all candidates,
of the products of the features: the costs are to be what a search along paths needs.

Ref: J. Zbontar, Y. LeCun, "Stereo matching by training a convolutional neural network to compare
image patches", JMLR 17, 2016; W. Luo, A. Schwing, R. Urtasun, "Efficient deep learning for stereo
matching", CVPR 2016 (the softmax over candidates).
"""

import argparse
import time
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from recon.evaluation.middlebury.bench import find_scenes, read_scored_scene

HEIGHT, WIDTH, BORDER = 96, 256, (12, 16)  # of a sample, and what of it has no full view around it
CHANNELS, LAYERS, FEATURES = 32, 5, 48
BATCH, RATE = 4, 1.2e-3
TEMPERATURE = 3.2  # of a trained network; its file has none
LEFT_OUT = {"Art"}
GREY = np.array([0.299, 0.587, 0.114], np.float32)
Float = NDArray[np.float32]


class Sample(NamedTuple):
    """A pair of pictures with its truth."""

    left: Float  # (HEIGHT, WIDTH)
    right: Float  # (HEIGHT, offset + WIDTH)
    truth: Float  # (HEIGHT, WIDTH); NaN = unknown or hidden
    offset: int  # columns that the right view has more, at its left
    ndisp: int


class Network(nn.Module):
    """Describes pixels by what is around them, at three sizes."""

    def __init__(self) -> None:
        super().__init__()

        def stack() -> nn.ModuleList:
            inputs = [1] + [CHANNELS] * (LAYERS - 1)
            return nn.ModuleList(nn.Conv2d(n, CHANNELS, 3, padding=1) for n in inputs)

        self.a, self.b, self.d = stack(), stack(), stack()
        self.f = nn.Conv2d(3 * CHANNELS, FEATURES, 1)
        self.t = nn.Parameter(torch.tensor(2.5))  # logarithm of the softmax's inverse temperature

    def forward(self, grey: Any) -> Any:
        half = functional.avg_pool2d(grey, 2)
        quarter = functional.avg_pool2d(half, 2)
        parts = [
            _through(self.a, grey),
            _enlarged(_through(self.b, 2 * half), 2),
            _enlarged(_through(self.d, 4 * quarter), 4),
        ]
        return self.f(torch.cat(parts, 1))


def _through(layers: nn.ModuleList, features: Any) -> Any:
    for layer in layers:
        features = functional.leaky_relu(layer(features), 0.1)
    return features


def _enlarged(features: Any, factor: int) -> Any:
    return functional.interpolate(
        features, scale_factor=float(factor), mode="bilinear", align_corners=False
    )


def read_photographs(folder: Path) -> list[Float]:
    found = []
    for path in sorted(folder.rglob("*")):
        image = cv2.imread(str(path)) if path.is_file() else None
        if image is None or min(image.shape[:2]) < 700:
            continue
        scale = min(1.0, 1600 / max(image.shape[:2]))
        size = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = size @ GREY[::-1]
        if np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean() > 1:
            found.append(grey.astype(np.float32))
    return found


def read_scenes(folder: Path) -> list[tuple[Float, Float, Float, int]]:
    found = []
    for year in ("2003", "2005", "2006"):
        for name, path in find_scenes(folder / year).items():
            scene = read_scored_scene(name, path, None)
            if scene is None or name in LEFT_OUT:
                continue
            hidden = np.False_ if scene.truth.nonocc is None else ~scene.truth.nonocc
            truth = np.where(hidden, np.float32(np.nan), scene.truth.values)
            left, right = (v.astype(np.float32) for v in (scene.pair.left, scene.pair.right))
            found.append((left, right, truth, int(scene.camera.ndisp or 64)))
    return found


def real_sample(rng: np.random.Generator, scenes: list[Any]) -> Sample:
    left, right, truth, ndisp = scenes[rng.integers(len(scenes))]
    mix = GREY if rng.random() < 0.5 else rng.dirichlet((2, 4, 1)).astype(np.float32)
    views = [left @ mix, right @ mix, truth]
    if rng.random() < 0.5:
        views = [view[::-1] for view in views]
    # As in whole images, both views are halved from columns that are multiples of four.
    y = rng.integers(0, truth.shape[0] - HEIGHT + 1)
    x = rng.integers(0, truth.shape[1] - WIDTH + 1) // 4 * 4
    start = max(0, x - (ndisp + 3) // 4 * 4)
    rows, columns = slice(y, y + HEIGHT), slice(x, x + WIDTH)
    level = rng.uniform(0.6, 1.3) * (10 ** rng.uniform(-1, 0) if rng.random() < 0.5 else 1)
    one = _lit(rng, views[0][rows, columns], level)
    other = _lit(rng, views[1][rows, start : x + WIDTH], level)
    one, other = _noisy(rng, one, _raised(rng, other))
    return Sample(one, other, np.ascontiguousarray(views[2][rows, columns]), x - start, ndisp)


def rendered_sample(rng: np.random.Generator, photographs: list[Float]) -> Sample:
    ndisp = 4 * int(rng.integers(10, 33))
    left, right, truth = render(rng, ndisp, photographs)
    level = rng.uniform(0.7, 1.2)
    one, other = _lit(rng, left[:, ndisp:], level), _lit(rng, right, level)
    if rng.random() < 0.5:
        light = rng.normal(size=(2, 4)).astype(np.float32) * rng.uniform(0, 8)
        other = other + cv2.resize(light, other.shape[::-1], interpolation=cv2.INTER_CUBIC)
    if rng.random() < 0.5:
        sigma = rng.uniform(0.2, 0.6)
        one = cv2.GaussianBlur(one, (0, 0), sigma)
        other = cv2.GaussianBlur(other, (0, 0), max(sigma + rng.uniform(-0.15, 0.15), 0.05))
    one, other = _noisy(rng, one, _raised(rng, other))
    return Sample(one, other, np.ascontiguousarray(truth[:, ndisp:]), ndisp, ndisp)


def _lit(rng: np.random.Generator, grey: Float, level: float) -> Float:
    gamma, gain = rng.uniform(0.9, 1.1), level * rng.uniform(0.9, 1.1)
    lit = 255 * (np.clip(grey, 0, 255) / 255) ** gamma * gain + rng.uniform(-6, 6)
    return np.asarray(lit, np.float32)


def _raised(rng: np.random.Generator, grey: Float) -> Float:
    """Move the view by a part of a row, in three of ten."""
    if rng.random() >= 0.3:
        return grey
    move = np.array([[1, 0, 0], [0, 1, rng.normal() * 0.3]], np.float32)
    moved = cv2.warpAffine(grey, move, grey.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved)


def _noisy(rng: np.random.Generator, *views: Float) -> list[Float]:
    sigma = rng.choice([0.15, 0.3, 0.6, 1.2])
    seen = [view + rng.normal(size=view.shape) * sigma for view in views]
    return [(np.round(2 * view) / 2).astype(np.float32) for view in seen]


def render(
    rng: np.random.Generator, ndisp: int, photographs: list[Float]
) -> tuple[Float, Float, Float]:
    """Return left, right and truth (NaN = hidden) of planes that hide each other."""
    width, margin = WIDTH + ndisp, 24
    left, right, truth = np.zeros((3, HEIGHT, width), np.float32)
    which, which_right = np.zeros((2, HEIGHT, width), np.int32)
    rows, columns = np.mgrid[:HEIGHT, :width].astype(np.float32)
    count = rng.integers(2, 10)
    if rng.random() < 0.7:
        disparities = np.sort(rng.uniform(2, ndisp - 6, count))
    else:
        disparities = np.sort(rng.uniform(2, ndisp - 6) * rng.uniform(0.9, 1.1, count))
    for layer, disparity in enumerate(disparities):
        across, down = rng.normal() * (0.08 if layer else 0.04), rng.normal() * 0.12
        x, y = (rng.uniform(ndisp / 2, width), rng.uniform(0, HEIGHT)) if layer else (width / 2, 48)
        plane = disparity + across * (columns - x) + down * (rows - y)
        there = (columns + disparity - across * x + down * (rows - y)) / (1 - across)
        shape = HEIGHT + 2 * margin, width + 2 * margin + ndisp
        picture, moved = texture(rng, *shape, photographs), rng.uniform(0, 1, 2) + margin
        mask = np.ones(shape, np.float32)
        if layer:
            mask = _outline(rng, shape, (x + margin, y + margin))
        for view, seen_by, at in ((left, which, columns), (right, which_right, there)):
            seen = cv2.remap(
                picture,
                *((at + moved[0]).astype(np.float32), (rows + moved[1]).astype(np.float32)),
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REFLECT_101,
            )
            inside = (at + margin).astype(np.float32), (rows + margin).astype(np.float32)
            covered = cv2.remap(mask, *inside, cv2.INTER_LINEAR) > 0.5 if layer else mask[0, 0] > 0
            view[:] = np.where(covered, seen, view)
            seen_by[:] = np.where(covered, layer, seen_by)
            if seen_by is which:
                truth[:] = np.where(covered, plane, truth)
    place = np.round(columns - truth).astype(int)
    both = (place >= 0) & (place < width) & (truth >= 0) & (truth < ndisp - 2)
    both &= which_right[rows.astype(int), place.clip(0, width - 1)] == which
    return left, right, np.where(both, truth, np.float32(np.nan))


def _outline(
    rng: np.random.Generator, shape: tuple[int, int], middle: tuple[float, float]
) -> Float:
    mask, kind = np.zeros(shape, np.uint8), rng.random()
    if kind < 0.35:
        axes = int(rng.uniform(4, 70)), int(rng.uniform(4, 50))
        whole = (int(middle[0]), int(middle[1]))
        cv2.ellipse(mask, whole, axes, rng.uniform(0, 180), 0, 360, 1, -1)
    elif kind < 0.7:
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
        corners = np.stack([np.cos(angles), np.sin(angles)], 1) * rng.uniform(8, 80) + middle
        cv2.fillPoly(mask, [corners.astype(np.int32)], 1)
    else:
        angle = rng.uniform(0, np.pi)
        reach = np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(30, 120)
        ends = [tuple(int(v) for v in middle + side * reach) for side in (-1, 1)]
        cv2.line(mask, *ends, 1, int(rng.uniform(2, 12)))
    return mask.astype(np.float32)


def texture(rng: np.random.Generator, height: int, width: int, photographs: list[Float]) -> Float:
    if rng.random() < 0.7:
        picture = photographs[rng.integers(len(photographs))]
        scale = np.exp(rng.uniform(np.log(0.35), np.log(1.6)))
        tall, wide = int(height / scale) + 2, int(width / scale) + 2
        if tall <= picture.shape[0] and wide <= picture.shape[1]:
            y = rng.integers(0, picture.shape[0] - tall + 1)
            x = rng.integers(0, picture.shape[1] - wide + 1)
            way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
            part = cv2.resize(
                picture[y : y + tall, x : x + wide], (width, height), interpolation=way
            )
            contrast = 10 ** rng.uniform(-0.9, 0.1) if rng.random() < 0.5 else 1.0
            part = part[:, ::-1] if rng.random() < 0.5 else part
            return np.asarray(part.mean() + (part - part.mean()) * contrast, np.float32)
    noise = _noise(rng, height, width) * 10 ** rng.uniform(-0.2, 1.5) + rng.uniform(20, 220)
    if rng.random() < 0.25:
        period, angle = rng.uniform(4, 40), rng.uniform(0, np.pi)
        y, x = np.mgrid[:height, :width]
        waves = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)
        noise += rng.uniform(2, 40) * np.sign(waves)
    return np.asarray(noise, np.float32)


def _noise(rng: np.random.Generator, height: int, width: int) -> Float:
    """Return noise whose spectrum falls with a random power of the frequency."""
    power, stretch = rng.uniform(0.3, 1.6), np.exp(0.7 * rng.normal())
    frequency = np.hypot(
        np.fft.fftfreq(height)[:, None] * stretch, np.fft.rfftfreq(width)[None]
    ) + (1 / 256)
    white = np.fft.rfft2(rng.normal(size=(height, width)))
    noise = np.fft.irfft2(white / frequency**power, s=(height, width))
    return np.asarray((noise - noise.mean()) / (noise.std() + 1e-9), np.float32)


def loss_of(network: Network, sample: Sample) -> Any:
    """Return the cross entropy of one sample; None where too little of its truth is known."""
    left, right = (torch.from_numpy(view)[None, None] / 32 for view in (sample[0], sample[1]))
    level = left.mean()

    def described(view: Any) -> Any:
        with torch.autocast("cpu", torch.bfloat16):
            features = network((view - level).contiguous(memory_format=torch.channels_last))
        return functional.normalize(features.float(), dim=1)[0]

    one, other = described(left), described(right)
    products = torch.bmm(one.permute(1, 2, 0).bfloat16(), other.permute(1, 0, 2).bfloat16()).float()
    places = torch.arange(WIDTH)[:, None] + sample.offset - torch.arange(sample.ndisp)[None]
    inside = places.clamp(min=0)[None].expand(HEIGHT, -1, -1)
    scores = torch.gather(products, 2, inside) * torch.exp(network.t)
    scores = scores.masked_fill(~(places >= 0)[None], -30.0)
    truth = torch.from_numpy(sample.truth)
    known = torch.isfinite(truth) & (truth < sample.ndisp - 1.01)
    known &= truth < torch.arange(WIDTH)[None] + sample.offset - 1
    known[: BORDER[0]] = known[-BORDER[0] :] = False
    known[:, : BORDER[1]] = known[:, -BORDER[1] :] = False
    if known.sum() < 50:
        return None
    logs, wanted = functional.log_softmax(scores, 2)[known], truth[known]
    whole = wanted.floor().long().clamp(min=0)
    part = wanted - whole
    low, high = (logs.gather(1, whole[:, None] + step)[:, 0] for step in (0, 1))
    return -((1 - part) * low + part * high).mean()


def started(start: Path | None) -> Network:
    """Return a network of random weights, or of those of a file."""
    torch.manual_seed(0)
    network = Network()
    if start is not None:
        found = {name: torch.from_numpy(array) for name, array in np.load(start).items()}
        network.load_state_dict({**network.state_dict(), **found})
        network.t.data.fill_(TEMPERATURE)
    return network.to(memory_format=torch.channels_last)


def train(network: Network, data: tuple[list[Float], list[Any]], minutes: float) -> Network:
    photographs, scenes = data
    cv2.setNumThreads(1)
    optimiser = torch.optim.Adam(network.parameters(), RATE)
    samples: Queue[Sample] = Queue(64)

    def fill(seed: int) -> None:
        rng = np.random.default_rng(seed)
        while True:
            real = rng.random() < 0.5
            samples.put(real_sample(rng, scenes) if real else rendered_sample(rng, photographs))

    for seed in range(2):
        Thread(target=fill, args=(seed,), daemon=True).start()
    start, losses = time.monotonic(), []
    while (done := (time.monotonic() - start) / (60 * minutes)) < 1:
        for group in optimiser.param_groups:
            group["lr"] = RATE * (1 + np.cos(np.pi * done)) / 2 + 1e-5
        each = [loss_of(network, samples.get()) for _ in range(BATCH)]
        found = [loss for loss in each if loss is not None]
        if not found:
            continue
        loss = torch.stack(found).sum() / BATCH
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        losses.append(loss.item())
        if len(losses) % 200 == 0:
            print(f"{len(losses)} steps, {100 * done:.0f} %, loss {np.mean(losses[-200:]):.3f}")
    return network


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("middlebury", type=Path)
    parser.add_argument("--start", type=Path, help="go on from this network")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--into", type=Path, default=Path("features.npz"))
    given = parser.parse_args()
    data = read_photographs(given.photographs), read_scenes(given.middlebury)
    network = train(started(given.start), data, given.minutes)
    weights = {name: value.numpy() for name, value in network.state_dict().items() if name != "t"}
    np.savez(given.into, **weights)


if __name__ == "__main__":
    main()
