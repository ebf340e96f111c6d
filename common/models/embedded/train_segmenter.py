"""Trains the segmenter: the probability that a pixel and its neighbour show different things.

usage: train_segmenter.py OUT TEST_DIR TRAIN_DIR...     (folders of `slag-lab generate photos`)

The graph segmenter (Felzenszwalb and Huttenlocher 2004) merges pixels across the lightest edges first. This small
U-Net (Ronneberger et al. 2015) gives the edges' weights, in place of colour differences.

Generated things are plainly painted, real ones are not. So each thing gets a pattern that lies in space (stripes, checks,
tiles, blots, grain), so that it is drawn in perspective, and colours that may be those of the thing beside it (domain
randomisation, Tobin et al. 2017). What is left to find borders by is shape, shading, occlusion, and depth where it is known.
Depths are spoilt as those of trained splats are: blurred, displaced, bumpy, with floaters and holes.
"""

import argparse, json, math, pathlib, random, time

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

from train import halve

# The order of encoder/src/segment/graph.rs: right, down left, down, down right.
NEIGHBOURS = [(1, 0), (-1, 1), (0, 1), (1, 1)]
PATCH = 320
# Of `generate photos`: 640 px wide, 75 degrees.
FOCAL_PX = 320 / math.tan(math.radians(37.5))
SKY = 65535
# Things that share a pattern: numbers modulo this.
PATTERNS = 64


class Block(nn.Sequential):
    def __init__(self, before, width):
        super().__init__(nn.Conv2d(before, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU(),
                         nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU())


class Boundaries(nn.Module):
    """[n, channels, h, w], h and w multiples of 32 -> [n, 4, h, w]: logits of a boundary between each pixel and
    its neighbours. Channels: red, green, blue, (level / 255 - 0.5) / 0.5; then those of `depth_channels`."""

    def __init__(self, channels, widths=(32, 64, 96, 128, 192)):
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(channels, widths[0], 4, stride=2, padding=1, bias=False), nn.BatchNorm2d(widths[0]), nn.ReLU())
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


def depth_channels(depth_m):
    """[n, 1, h, w], 0 where unknown -> [n, 4, h, w]: logarithm of depth over the median depth, its slopes to
    the right and down over 4 px, and whether depth is known. All are 0 where it is not."""
    known = depth_m > 0
    logs = torch.where(known, depth_m.clamp(min=1e-6).log(), torch.full_like(depth_m, float("nan")))
    median = torch.nanmedian(logs.flatten(1), 1).values.nan_to_num()[:, None, None, None]
    padded = F.pad(logs, (2, 2, 2, 2), mode="replicate")
    right = padded[:, :, 2:-2, 4:] - padded[:, :, 2:-2, :-4]
    down = padded[:, :, 4:, 2:-2] - padded[:, :, :-4, 2:-2]
    relative = ((logs - median) / 2).clamp(-2, 2)
    return torch.cat([relative.nan_to_num(), torch.tanh(20 * right).nan_to_num(), torch.tanh(20 * down).nan_to_num(), known.float()], 1)


def paint(x, things, depth_m, corner):
    """Gives things patterns and colours. x: [n, 3, h, w], 0 to 1; things: [n, h, w]; depth_m: [n, 1, h, w];
    corner: [n, 2], column and row of the patch in the photo."""
    n, _, h, w = x.shape
    device = x.device
    rand = lambda *shape: torch.rand(*shape, device=device)
    signed = lambda *shape: 2 * rand(*shape) - 1
    u = (torch.arange(w, device=device)[None] + corner[:, :1] - 320 + 0.5) / FOCAL_PX
    v = (torch.arange(h, device=device)[None] + corner[:, 1:] - 240 + 0.5) / FOCAL_PX
    depth = depth_m[:, 0].clamp(max=200)
    points = torch.stack([u[:, None, :] * depth, v[:, :, None] * depth, depth], -1)
    number = things % PATTERNS
    flat = number.flatten(1)
    of = lambda table: torch.gather(table, 1, flat[..., None].expand(-1, -1, table.shape[-1])).view(n, h, w, -1)
    # Axes of the pattern of each thing, in radians a metre: waves of 3 cm to 1.5 m.
    axes = F.normalize(torch.randn(n, PATTERNS, 3, 3, device=device), dim=-1)
    wave_m = 0.03 * 50 ** rand(n, PATTERNS, 1, 1)
    axes = of((axes * (2 * math.pi / wave_m)).flatten(2)).view(n, h, w, 3, 3)
    phase = of(signed(n, PATTERNS, 3) * math.pi)
    q = (axes * points[..., None, :]).sum(-1) + phase
    s = torch.sin(q)
    stripes = s[..., 0]
    checks = s[..., 0] * s[..., 1]
    tiles = (s[..., 0].abs().minimum(s[..., 1].abs()) < 0.1).float()
    # Blots and grain: waves that bend each other.
    bent = torch.sin(q[..., 0] + 1.7 * torch.sin(1.3 * q[..., 1]) + 1.1 * torch.sin(2.3 * q[..., 2]))
    grain = 0.5 * bent + 0.3 * torch.sin(3.1 * q[..., 1] + 2 * bent) + 0.2 * torch.sin(7.3 * q[..., 2] + 3 * bent)
    # Windows and other panels.
    panels = 2 * ((s[..., 0] > -0.3) & (s[..., 1] > -0.3)).float() - 1
    kind = of(torch.randint(0, 8, (n, PATTERNS, 1), device=device).float())[..., 0]
    hard = of((rand(n, PATTERNS, 1) < 0.5).float())[..., 0] > 0
    pattern = torch.where(kind == 0, stripes, torch.where(kind == 1, checks, torch.where(kind == 2, 2 * tiles - 1, torch.where(kind == 3, bent, torch.where(kind == 7, panels, grain)))))
    pattern = torch.where(hard, (4 * pattern).clamp(-1, 1), pattern)
    # Beyond what a pixel resolves, patterns fade.
    per_px = depth / FOCAL_PX * axes.norm(dim=-1).amax(-1)
    pattern = pattern * (1.5 - per_px / 1.2).clamp(0, 1)
    contrast = of(rand(n, PATTERNS, 3) ** 2 * 0.6 * (rand(n, PATTERNS, 1) < 0.6))
    contrast = contrast * of((rand(n, PATTERNS, 1) < 0.7).float() * torch.ones(n, PATTERNS, 3, device=device))
    contrast = torch.where((things == SKY)[..., None], 0.2 * contrast, contrast)
    factor = (1 + contrast * pattern[..., None]) / (1 + contrast)
    # Other colours; one in six photos has things of few, similar colours.
    recoloured = of((rand(n, PATTERNS, 1) < 0.5).float())
    spread = torch.where(rand(n, 1, 1) < 0.17, 0.15, 1.0)
    base = rand(n, 1, 3)
    colour = of((base + spread * (rand(n, PATTERNS, 3) - base)).clamp(0.12, 1))
    x = x.permute(0, 2, 3, 1)
    grey = x.mean(-1, keepdim=True)
    level = of(0.7 + rand(n, PATTERNS, 1))
    painted = torch.where(recoloured > 0, grey * level * colour * 1.5, x)
    return (painted * factor).permute(0, 3, 1, 2)


def augment(x):
    """Exposure, shadows, stains, blur and noise of cameras."""
    n = len(x)
    uniform = lambda *shape: 2 * torch.rand(*shape, device=x.device) - 1
    x = x * (1 + 0.35 * uniform(n, 1, 1, 1) + 0.1 * uniform(n, 3, 1, 1)) + 0.1 * uniform(n, 1, 1, 1)
    # Shadows and stains: gradual brightness changes, which are no boundaries.
    stain = F.interpolate(uniform(n, 1, 5, 5), size=x.shape[-2:], mode="bicubic")
    x = x * (1 + 0.25 * stain)
    # Hard shadows.
    shadow = F.interpolate(uniform(n, 1, 7, 7), size=x.shape[-2:], mode="bicubic") > 0.35
    x = x * torch.where(shadow & (torch.rand(n, 1, 1, 1, device=x.device) < 0.3), 0.5 + 0.4 * torch.rand(n, 1, 1, 1, device=x.device), 1.0)
    # Texture: noise at several scales.
    for size in (80, 160, 320):
        amount = 0.05 * torch.rand(n, 1, 1, 1, device=x.device)
        x = x + amount * F.interpolate(torch.randn(n, 1, size, size, device=x.device), size=x.shape[-2:], mode="bilinear")
    if random.random() < 0.4:
        size = random.choice([140, 200, 260])
        x = F.interpolate(F.interpolate(x, size=size, mode="area"), size=x.shape[-2:], mode="bilinear")
    # Blocks of JPEG: what is left of colour at a quarter of the resolution.
    if random.random() < 0.4:
        grey = x.mean(1, keepdim=True)
        x = grey + F.interpolate(F.avg_pool2d(x - grey, 4), scale_factor=4.0, mode="bilinear")
    x = x + 0.03 * torch.rand(n, 1, 1, 1, device=x.device) * torch.randn_like(x)
    return x.clamp(0, 1)


def spoil(depth_m):
    """Depths as a trained splat shows them. [n, 1, h, w], 0 where unknown."""
    n, _, h, w = depth_m.shape
    device = depth_m.device
    rand = lambda *shape: torch.rand(*shape, device=device)
    field = lambda size, channels=1: F.interpolate(torch.randn(n, channels, size, size, device=device), size=(h, w), mode="bicubic")
    # Borders move by some pixels.
    shift = field(random.choice([10, 20, 40]), 2) * 3 * rand(n, 1, 1, 1) ** 2 + field(80, 2) * 1.5 * rand(n, 1, 1, 1)
    y, x = torch.meshgrid(torch.linspace(-1, 1, h, device=device), torch.linspace(-1, 1, w, device=device), indexing="ij")
    grid = torch.stack([x + shift[:, 0] * 2 / w, y + shift[:, 1] * 2 / h], -1)
    inverse = torch.where(depth_m > 0, 1 / depth_m.clamp(min=1e-3), torch.zeros_like(depth_m))
    inverse = F.grid_sample(inverse, grid, mode=random.choice(["bilinear", "nearest"]), padding_mode="border", align_corners=False)
    # Gaussians straddle borders, so depth is blurred.
    size = random.choice([1, 3, 3, 5, 7])
    inverse = F.avg_pool2d(F.pad(inverse, (size // 2,) * 4, mode="replicate"), size, stride=1)
    # Surfaces are bumpy at the size of Gaussians and wavy in the large.
    for size in (20, 53, 107):
        inverse = inverse * (1 + 0.03 * rand(n, 1, 1, 1) ** 2 * field(size)).clamp(min=0.2)
    floaters = (field(random.choice([12, 25])) > 2.4 + 1.5 * rand(n, 1, 1, 1)).float()
    inverse = inverse * (1 + floaters * (0.1 + rand(n, 1, 1, 1)))
    holes = field(random.choice([12, 25])) > 2.2 + 2 * rand(n, 1, 1, 1)
    known = (inverse > 1 / 150) & ~holes & (rand(n, 1, 1, 1) > 0.15)
    return torch.where(known, 1 / inverse.clamp(min=1e-4), torch.zeros_like(inverse))


def load(folders, device):
    photos = torch.cat([torch.from_numpy(np.load(pathlib.Path(f) / "photos.npy")) for f in folders]).to(device)
    things = torch.cat([torch.from_numpy(np.load(pathlib.Path(f) / "things.npy").view(np.int16)) for f in folders]).to(device)
    depths = torch.cat([torch.from_numpy(np.load(pathlib.Path(f) / "depths.npy")).half() for f in folders]).to(device)
    return photos, things, depths


def pixels(photos, things, depths, places):
    """Patches as [n, 3, h, w] from 0 to 1, [n, h, w] numbers, and [n, 1, h, w] metres, 200 for the sky."""
    cut = lambda all: torch.stack([all[i, y:y + PATCH, x:x + PATCH] for i, y, x in places])
    x, ids, depth_m = cut(photos).permute(0, 3, 1, 2).float() / 255, cut(things).long() & 0xffff, cut(depths).float()[:, None]
    return x, ids, depth_m.clamp(max=200)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("test")
    parser.add_argument("train", nargs="+")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--batch", type=int, default=24)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--depth", action="store_true", help="the model also sees depths")
    parser.add_argument("--resume", type=pathlib.Path, help="weights to start from")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    device = args.device
    torch.manual_seed(args.seed); random.seed(args.seed); np.random.seed(args.seed)
    photos, things, depths = load(args.train, device)
    print(f"{len(photos)} photos on {device}", flush=True)
    channels = 7 if args.depth else 3
    model = Boundaries(channels).to(device).to(memory_format=torch.channels_last)
    if args.resume:
        model.load_state_dict(torch.load(args.resume, map_location=device))
    optimiser = torch.optim.AdamW(model.parameters(), lr=args.rate, weight_decay=0.01)
    began, step, mean = time.time(), 0, 0.0
    height, width = photos.shape[1:3]
    seen = lambda x, depth_m: torch.cat([(x - 0.5) / 0.5, depth_channels(depth_m)], 1) if args.depth else (x - 0.5) / 0.5
    coarse = things[:, ::16, ::16].cpu().numpy()

    def full_place():
        """The place with the most things of three."""
        places = [(np.random.randint(len(photos)), np.random.randint(height - PATCH + 1), np.random.randint(width - PATCH + 1)) for _ in range(3)]
        return max(places, key=lambda p: len(np.unique(coarse[p[0], p[1] // 16:(p[1] + PATCH) // 16, p[2] // 16:(p[2] + PATCH) // 16])))

    while True:
        done = (time.time() - began) / args.seconds
        if done >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = args.rate * min(1, (step + 1) / 200) * (0.5 + 0.5 * math.cos(math.pi * done))
        places = [full_place() for _ in range(args.batch)]
        with torch.no_grad():
            x, ids, depth_m = pixels(photos, things, depths, places)
            corner = torch.tensor([(x0, y0) for _, y0, x0 in places], device=device, dtype=torch.float32)
            truth, known = boundaries(ids)
            # A fifth of the photos stays as it is painted.
            as_it_is = torch.rand(len(x), 1, 1, 1, device=device) < 0.2
            x = augment(torch.where(as_it_is, x, paint(x, ids, depth_m, corner)))
            x = seen(x, spoil(torch.where(depth_m < 200, depth_m, 0)) if args.depth else None)
            if random.random() < 0.5:
                # Mirrored photos; the neighbour down left becomes the one down right.
                ids = ids.flip(-1)
                x = x.flip(-1)
                if args.depth:
                    x[:, 4] = -x[:, 4]
                truth, known = boundaries(ids)
            x = x.contiguous(memory_format=torch.channels_last)
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
    torch.save(model.state_dict(), args.out / "weights.pt")
    model.eval()
    photos, things, depths = load([args.test], device)
    right = found = there = 0
    with torch.no_grad():
        for photo, ids, depth_m in zip(photos[:200], things[:200], depths[:200]):
            ids, depth_m = ids.long()[None] & 0xffff, depth_m.float()[None, None]
            x = photo[None].permute(0, 3, 1, 2).float() / 255
            logits = model(seen(x, torch.where(depth_m < 200, depth_m, 0)))
            truth, known = boundaries(ids)
            said = (logits > 0) & known
            near = F.max_pool2d(truth, 3, stride=1, padding=1) > 0
            right += (said & near).sum().item(); found += said.sum().item()
            there += ((truth > 0) & (F.max_pool2d(said.float(), 3, stride=1, padding=1) > 0)).sum().item() / max(1, (truth > 0).sum().item())
    report = {"precision": right / max(1, found), "recall": there / min(200, len(photos)), "steps": step, "loss": mean}
    print(json.dumps(report), flush=True)
    (args.out / "report.json").write_text(json.dumps(report))
    model = model.cpu().to(memory_format=torch.contiguous_format)
    torch.onnx.export(nn.Sequential(model, nn.Sigmoid()), (torch.zeros(1, channels, 480, 640),), args.out / "segment.onnx", input_names=["pixel_values"],
                      output_names=["boundaries"], dynamic_axes={"pixel_values": {2: "height", 3: "width"}, "boundaries": {2: "height", 3: "width"}},
                      opset_version=17, dynamo=False)
    halve(args.out / "segment.onnx")


if __name__ == "__main__":
    main()
