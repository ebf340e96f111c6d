"""Measures how the square that an image encoder sees is made of a mask's crop: cut at the centre, padded, or stretched.

    measure_crops.py SHARED SCENE...      # scenes with gt/masks and gt/instances.json, given masks, all training views

Each mask of at least 400 pixels that does not touch the photo's border is cropped to its box, white outside, and
encoded; right is a crop whose most similar word among the scene's categories is its own. Figures are shares of right
crops by the box's longer edge over its shorter one. Encoders: the embedded one, and ConSE (SHARED/models).
Needs numpy, Pillow, onnxruntime, tokenizers and safetensors.
"""
import json
import pathlib
import sys
import tomllib

import numpy as np
import onnxruntime
from PIL import Image
from safetensors.numpy import load_file
from tokenizers import Tokenizer

ROOT = pathlib.Path(__file__).resolve().parent.parent
SHARED = pathlib.Path(sys.argv[1])
BINS = [(1, 1.5), (1.5, 2.5), (2.5, 4), (4, 100)]


def session(path):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


class Conse:
    def __init__(self):
        models = SHARED / "models"
        self.size, self.mean, self.std = 224, 128 / 255, 128 / 255
        self.model = session(models / "image_encoder/conse_mnv2_int8.onnx")
        phrases = (models / "clip_text/phrases.txt").read_text().splitlines()
        tensors = load_file(models / "clip_text/vectors.safetensors")
        vectors = unit(unit(tensors["vectors"].astype(np.float64)) - tensors["mean"].astype(np.float64))
        self.words = dict(zip(phrases, vectors))

    def text(self, word):
        return self.words.get(word)


class Embedded:
    def __init__(self):
        folder = ROOT / "common/models/embedded"
        description = tomllib.loads((folder / "model.toml").read_text())
        image, self.described = description["image"], description["text"]
        self.size, self.mean, self.std = image["size_px"], np.array(image["mean"]), np.array(image["std"])
        self.model = session(folder / "image.onnx")
        self.text_model = session(folder / "text.onnx")
        self.tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))

    def text(self, word):
        ids = self.tokenizer.encode(self.described["prompt"].replace("{}", word)).ids
        names = [i.name for i in self.text_model.get_inputs()]
        feeds = {names[0]: np.array([ids], np.int64)}
        if len(names) > 1:
            feeds[names[1]] = np.ones((1, len(ids)), np.int64)
        return unit(self.text_model.run(None, feeds)[0][0].astype(np.float64))


def square(crop, how, size):
    width, height = crop.size
    if how == "stretch":
        return crop.resize((size, size), Image.BICUBIC)
    if how == "centre":
        short = min(width, height)
        resized = [size * width // short, size * height // short]
        left, top = [(edge - size) // 2 for edge in resized]
        return crop.resize(resized, Image.BICUBIC).crop((left, top, left + size, top + size))
    scale = size / max(width, height)
    resized = crop.resize([max(1, round(width * scale)), max(1, round(height * scale))], Image.BICUBIC)
    out = Image.new("RGB", (size, size), "white")
    out.paste(resized, ((size - resized.width) // 2, (size - resized.height) // 2))
    return out


def main():
    for scene in map(pathlib.Path, sys.argv[2:]):
        found = json.loads((scene / "gt/instances.json").read_text())
        instances = found["instances"] if isinstance(found, dict) else found
        category = {i["id"]: i["category"] for i in instances}
        crops = []
        for path in sorted((scene / "gt/masks").glob("*.png")):
            ids = np.asarray(Image.open(path))
            photo = np.asarray(Image.open(scene / "images" / f"{path.stem}.jpg").convert("RGB"))
            for k in np.unique(ids):
                if k not in category or category[k] in ("floor", "wall", "ceiling", "ground", "sky", "road"):
                    continue
                inside = ids == k
                rows, columns = np.where(inside.any(1))[0], np.where(inside.any(0))[0]
                y0, y1, x0, x1 = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
                touches = y0 == 0 or x0 == 0 or y1 == ids.shape[0] or x1 == ids.shape[1]
                if touches or inside.sum() < 400:
                    continue
                crop = np.where(inside[..., None], photo, 255)[y0:y1, x0:x1].astype(np.uint8)
                aspect = max(crop.shape[:2]) / min(crop.shape[:2])
                crops.append((Image.fromarray(crop), category[k], aspect))
        for encoder in (Conse(), Embedded()):
            words = sorted({word for _, word, _ in crops})
            known = {word: encoder.text(word) for word in words}
            words = [word for word in words if known[word] is not None]
            texts = np.stack([known[word] for word in words])
            usable = [crop for crop in crops if crop[1] in words]
            right = {}
            for how in ("centre", "pad", "stretch"):
                hits = []
                for crop, word, _ in usable:
                    pixels = np.asarray(square(crop, how, encoder.size)) / 255
                    pixels = ((pixels - encoder.mean) / encoder.std).astype(np.float32).transpose(2, 0, 1)[None]
                    vector = encoder.model.run(None, {encoder.model.get_inputs()[0].name: pixels})[0][0]
                    hits.append(words[int(np.argmax(texts @ vector))] == word)
                right[how] = np.array(hits)
            aspects = np.array([aspect for *_, aspect in usable])
            print(f"{scene.name}, {type(encoder).__name__}: {len(usable)} crops, {len(words)} words", flush=True)
            for low, high in [*BINS, (1, 100)]:
                among = (aspects >= low) & (aspects < high)
                shares = ", ".join(f"{how} {right[how][among].mean():.3f}" for how in right)
                gained = (right["pad"] & ~right["centre"])[among].sum(), (right["centre"] & ~right["pad"])[among].sum()
                print(f"  {low} to {high}: n {among.sum()}, {shares}; pad alone {gained[0]}, centre alone {gained[1]}")


main()
