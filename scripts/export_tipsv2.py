#!/usr/bin/env python3
"""Exports TIPSv2 (Google, published as PyTorch weights) to a model directory with vectors of patches.

    export_tipsv2.py OUT [google/tipsv2-l14]     # OUT/{vision.onnx, text.onnx, tokenizer.json, model.toml}

Needs PyTorch, transformers 5 (Tipsv2Model) and the hub. Written from transformers' source; not run on the trained weights
where this project was built, which reaches no hub: the layout it writes is tested with random weights (tests/models/
dense_tiny). It compares both files with PyTorch before it writes model.toml.
"""
import hashlib
import pathlib
import sys

import numpy as np
import onnxruntime
import torch
from transformers import AutoTokenizer, Tipsv2Model

OUT = pathlib.Path(sys.argv[1])
NAME = sys.argv[2] if len(sys.argv) > 2 else "google/tipsv2-l14"


class Vision(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixel_values):
        states = self.model(pixel_values).last_hidden_state
        return states[:, 0], states[:, 1 + self.model.config.num_register_tokens:]


class Text(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, input_ids, attention_mask):
        return self.model(input_ids=input_ids, attention_mask=attention_mask).pooler_output


def export(module, inputs, name, inputs_names, outputs, dynamic):
    path = OUT / name
    torch.onnx.export(module, inputs, str(path), opset_version=17, input_names=inputs_names, output_names=outputs,
                      dynamic_axes=dynamic, dynamo=False)
    found = onnxruntime.InferenceSession(str(path)).run(None, {n: x.numpy() for n, x in zip(inputs_names, inputs)})
    expected = module(*inputs)
    expected = expected if isinstance(expected, tuple) else (expected,)
    for a, b in zip(found, expected):
        difference = float(np.abs(a - b.numpy()).max())
        assert difference < 1e-2, f"{name}: ONNX Runtime and PyTorch differ by {difference}"
    return path


def file_of(path):
    return f'{{ path = "{path.name}", sha256 = "{hashlib.sha256(path.read_bytes()).hexdigest()}" }}'


@torch.no_grad()
def main():
    OUT.mkdir(parents=True, exist_ok=True)
    model = Tipsv2Model.from_pretrained(NAME, attn_implementation="eager").eval().float()
    vision, size, patch = model.vision_model, 448, 14
    # The square has the size of training, so positions need no interpolation, which ONNX lacks.
    vision.embeddings.interpolate_pos_encoding = lambda *_: vision.embeddings.position_embeddings
    batch, tokens = {0: "batch_size"}, {0: "batch_size", 1: "sequence_length"}
    image_path = export(
        Vision(vision), (torch.rand(1, 3, size, size),), "vision.onnx", ["pixel_values"],
        ["image_embeds", "patch_embeddings"],
        {name: batch for name in ["pixel_values", "image_embeds", "patch_embeddings"]})
    tokenizer = AutoTokenizer.from_pretrained(NAME)
    tokenizer.backend_tokenizer.save(str(OUT / "tokenizer.json"))
    ids = tokenizer("a photo of a chair", return_tensors="pt")
    text_path = export(
        Text(model.text_model), (ids["input_ids"], ids["attention_mask"]), "text.onnx", ["input_ids", "attention_mask"],
        ["text_embeds"], {"input_ids": tokens, "attention_mask": tokens, "text_embeds": batch})
    (OUT / "model.toml").write_text(f'''name = "{NAME.split("/")[-1]}"
about = "Google's TIPSv2: patches aligned with text, for --regions patches."
dim = {model.config.vision_config.hidden_size}
licence = "Apache-2.0"

[image]
file = {file_of(image_path)}
input = "pixel_values"
output = "image_embeds"
size_px = {size}
resize = "pad"
filter = "bilinear"
mean = [0.0, 0.0, 0.0]
std = [1.0, 1.0, 1.0]
normalise = true
patches = {{ output = "patch_embeddings", patch_px = {patch} }}

[text]
kind = "onnx"
file = {file_of(text_path)}
tokenizer = {file_of(OUT / "tokenizer.json")}
input_ids = "input_ids"
attention_mask = "attention_mask"
output = "text_embeds"
max_tokens = 64
prompt = "a photo of a {{}}"
lowercase = true
''')


main()
