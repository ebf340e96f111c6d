"""Trains the segmenter: the probability that a pixel and its neighbour show different things.

usage: train_segmenter.py OUT TEST_DIR TRAIN_DIR...     (folders of `slag-lab generate photos`)

The graph segmenter (Felzenszwalb and Huttenlocher 2004) merges pixels across the lightest edges first. This small
U-Net (Ronneberger et al. 2015) gives the edges' weights, in place of colour differences.
"""

import argparse, json, math, pathlib, random, time

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from train import halve

# The order of encoder/src/segment/graph.rs: right, down left, down, down right.
NEIGHBOURS = [(1, 0), (-1, 1), (0, 1), (1, 1)]
PATCH = 256


class Block(nn.Sequential):
    def __init__(self, before, width):
        super().__init__(nn.Conv2d(before, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU(),
                         nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU())


class Boundaries(nn.Module):
    """[n, 3, h, w], (level / 255 - 0.5) / 0.5, h and w multiples of 16 -> [n, 4, h, w]: logits of a boundary
    between each pixel and its neighbours."""

    def __init__(self, widths=(16, 32, 64, 96)):
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(3, widths[0], 4, stride=2, padding=1, bias=False), nn.BatchNorm2d(widths[0]), nn.ReLU())
        self.down = nn.ModuleList(Block(a, b) for a, b in zip((widths[0],) + widths[:-1], widths))
        self.up = nn.ModuleList(Block(a + b, b) for a, b in zip(widths[:0:-1], widths[-2::-1]))
        self.head = nn.Conv2d(widths[0], 4 * len(NEIGHBOURS), 3, padding=1)

    def forward(self, x):
        x = self.stem(x)
        skips = []
        for i, block in enumerate(self.down):
            x = block(F.max_pool2d(x, 2) if i else x)
            skips.append(x)
        for block, skip in zip(self.up, skips[-2::-1]):
            x = block(torch.cat([F.interpolate(x, scale_factor=2.0, mode="bilinear"), skip], 1))
        return F.pixel_shuffle(self.head(x), 2)


def boundaries(things):
    """[n, h, w] -> [n, 4, h, w], 1 where a pixel and its neighbour show different things; and where both exist."""
    n, h, w = things.shape
    truth = torch.zeros(n, 4, h, w, device=things.device)
    known = torch.zeros(n, 4, h, w, dtype=torch.bool, device=things.device)
    for i, (dx, dy) in enumerate(NEIGHBOURS):
        rows, other_rows = slice(0, h - dy), slice(dy, h)
        columns, others = slice(max(0, -dx), w - max(0, dx)), slice(max(0, dx), w - max(0, -dx))
        truth[:, i, rows, columns] = (things[:, rows, columns] != things[:, other_rows, others]).float()
        known[:, i, rows, columns] = True
    return truth, known


def augment(x):
    n = len(x)
    uniform = lambda *shape: 2 * torch.rand(*shape, device=x.device) - 1
    x = x * (1 + 0.25 * uniform(n, 1, 1, 1) + 0.1 * uniform(n, 3, 1, 1)) + 0.1 * uniform(n, 1, 1, 1)
    # Shadows and stains: gradual brightness changes, which are no boundaries.
    stain = F.interpolate(uniform(n, 1, 5, 5), size=x.shape[-2:], mode="bicubic")
    x = x * (1 + 0.25 * stain)
    # Texture: noise at several scales.
    for size in (64, 128, 256):
        amount = 0.05 * torch.rand(n, 1, 1, 1, device=x.device)
        x = x + amount * F.interpolate(torch.randn(n, 1, size, size, device=x.device), size=x.shape[-2:], mode="bilinear")
    x = x + 0.02 * torch.rand(n, 1, 1, 1, device=x.device) * torch.randn_like(x)
    if random.random() < 0.3:
        size = random.choice([112, 160, 200])
        x = F.interpolate(F.interpolate(x, size=size, mode="area"), size=x.shape[-2:], mode="bilinear")
    return x.clamp(0, 1)


def load(folders, device):
    photos = torch.cat([torch.from_numpy(np.load(pathlib.Path(f) / "photos.npy")) for f in folders])
    things = torch.cat([torch.from_numpy(np.load(pathlib.Path(f) / "things.npy").astype(np.int32)) for f in folders])
    return photos.to(device), things.to(device)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("test")
    parser.add_argument("train", nargs="+")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    device = args.device
    torch.manual_seed(args.seed); random.seed(args.seed); np.random.seed(args.seed)
    photos, things = load(args.train, device)
    print(f"{len(photos)} photos on {device}", flush=True)
    model = Boundaries().to(device).to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(model.parameters(), lr=args.rate, weight_decay=0.01)
    began, step, mean = time.time(), 0, 0.0
    height, width = photos.shape[1:3]
    while True:
        done = (time.time() - began) / args.seconds
        if done >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = args.rate * min(1, (step + 1) / 200) * (0.5 + 0.5 * math.cos(math.pi * done))
        places = [(np.random.randint(len(photos)), np.random.randint(height - PATCH + 1), np.random.randint(width - PATCH + 1)) for _ in range(args.batch)]
        cut = lambda all: torch.stack([all[i, y:y + PATCH, x:x + PATCH] for i, y, x in places])
        x, ids = cut(photos).permute(0, 3, 1, 2).float() / 255, cut(things)
        if random.random() < 0.5:
            x, ids = x.flip(-1), ids.flip(-1)
        truth, known = boundaries(ids)
        x = ((augment(x) - 0.5) / 0.5).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device, dtype=torch.bfloat16):
            logits = model(x)
        # Boundary pixels are few, so they are weighted three times.
        loss = F.binary_cross_entropy_with_logits(logits.float(), truth, weight=known * (1 + 2 * truth))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        step += 1
        if step % 50 == 0:
            mean = loss.item() if mean == 0 else 0.9 * mean + 0.1 * loss.item()
        if step % 500 == 0:
            print(f"{step} {time.time() - began:.0f} s  loss {mean:.4f}", flush=True)
    model.eval()
    photos, things = load([args.test], device)
    right = found = there = 0
    with torch.no_grad():
        for photo, ids in zip(photos[:200], things[:200]):
            logits = model((photo[None].permute(0, 3, 1, 2).float() / 255 - 0.5) / 0.5)
            truth, known = boundaries(ids[None])
            said = (logits > 0) & known
            near = F.max_pool2d(truth, 3, stride=1, padding=1) > 0
            right += (said & near).sum().item(); found += said.sum().item()
            there += ((truth > 0) & (F.max_pool2d(said.float(), 3, stride=1, padding=1) > 0)).sum().item() / max(1, (truth > 0).sum().item())
    report = {"precision": right / max(1, found), "recall": there / min(200, len(photos)), "steps": step, "loss": mean}
    print(json.dumps(report), flush=True)
    (args.out / "report.json").write_text(json.dumps(report))
    model = model.cpu().to(memory_format=torch.contiguous_format)
    torch.onnx.export(nn.Sequential(model, nn.Sigmoid()), (torch.zeros(1, 3, 480, 640),), args.out / "segment.onnx", input_names=["pixel_values"],
                      output_names=["boundaries"], dynamic_axes={"pixel_values": {2: "height", 3: "width"}, "boundaries": {2: "height", 3: "width"}},
                      opset_version=17, dynamo=False)
    halve(args.out / "segment.onnx")


if __name__ == "__main__":
    main()
