"""Writes an image model with vectors of patches: the architecture of DINOv2 with registers, which TIPSv2's
image tower has, with small random weights, and what PyTorch computes with it. Its vectors mean nothing; the
code path is the real one.

    export.py OUT        # vision.onnx, vectors.safetensors, phrases.txt, golden.npz

Needs torch 2.4.1, transformers 4.57.1, onnx 1.17, onnxruntime, safetensors, numpy and Pillow.
"""
import sys
import warnings

import numpy as np
import onnxruntime
import torch
from PIL import Image
from safetensors.numpy import save_file
from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

warnings.filterwarnings("ignore")
OUT, SIZE, PATCH, DIM, N_REGISTERS = sys.argv[1], 56, 14, 16, 1


class Vision(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixel_values):
        states = self.model(pixel_values).last_hidden_state
        return states[:, 0], states[:, 1 + N_REGISTERS:]


@torch.no_grad()
def main():
    torch.manual_seed(5)
    config = Dinov2WithRegistersConfig(
        hidden_size=DIM, num_hidden_layers=2, num_attention_heads=2, mlp_ratio=2, image_size=SIZE, patch_size=PATCH,
        num_register_tokens=N_REGISTERS)
    config._attn_implementation = "eager"
    model = Dinov2WithRegistersModel(config).eval()
    for parameter in model.parameters():
        parameter.copy_(torch.randn_like(parameter) * (0.3 if parameter.dim() > 1 else 0.2) + (parameter == 1))
    # The square has the size of training, so positions need no interpolation, which ONNX lacks.
    model.embeddings.interpolate_pos_encoding = lambda *_: model.embeddings.position_embeddings
    vision = Vision(model)
    rng = np.random.default_rng(8)
    photo = np.asarray(Image.fromarray(rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)).resize((75, 43), Image.BICUBIC))
    square = np.asarray(Image.fromarray(photo).resize((SIZE, SIZE), Image.BILINEAR))
    pixels = torch.from_numpy((square / 255).astype(np.float32).transpose(2, 0, 1)[None].copy())
    batch = {0: "batch_size"}
    torch.onnx.export(
        vision, (pixels,), f"{OUT}/vision.onnx", opset_version=17, input_names=["pixel_values"], dynamo=False,
        output_names=["image_embeds", "patch_embeddings"],
        dynamic_axes={name: batch for name in ["pixel_values", "image_embeds", "patch_embeddings"]})
    expected = [x.numpy() for x in vision(pixels)]
    session = onnxruntime.InferenceSession(f"{OUT}/vision.onnx", providers=["CPUExecutionProvider"])
    found = session.run(None, {"pixel_values": pixels.numpy()})
    print([x.shape for x in found], [np.abs(a - b).max() for a, b in zip(found, expected)])
    np.savez_compressed(f"{OUT}/golden.npz", image=photo, image_embeds=expected[0][0], patch_embeddings=expected[1][0])
    phrases = ["chair", "table", "lamp"]
    open(f"{OUT}/phrases.txt", "w").write("".join(f"{phrase}\n" for phrase in phrases))
    save_file({"vectors": rng.standard_normal((len(phrases), DIM)).astype(np.float32)}, f"{OUT}/vectors.safetensors")


main()
