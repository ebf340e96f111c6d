"""Writes SigLIP 2's architecture (of the models with squares of one size, which is SigLIP's) with small random
weights, as its public ONNX exports lay it out, a small tokenizer of Gemma's kind, and what transformers and
PyTorch compute with them. Its vectors mean nothing; the code path is the real one.

    export.py OUT        # vision_model.onnx, text_model.onnx, tokenizer.json, golden.npz, golden_tokens.json

Needs torch 2.4.1, transformers 4.57.1, onnx 1.17, onnxruntime, numpy and Pillow 10.4. The seed is fixed. Pillow 13 differs by
a level in photos that grow one way and shrink the other.
"""
import json
import os
import sys
import warnings

import numpy as np
import onnxruntime
import torch
from PIL import Image
from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, trainers
from transformers import GemmaTokenizerFast, SiglipConfig, SiglipImageProcessor, SiglipModel

warnings.filterwarnings("ignore")
OUT, SIZE, PATCH, DIM, N_TOKENS = sys.argv[1], 48, 16, 24, 64
# Learnt from these; the last texts have letters that the vocabulary lacks.
LEARNT = [
    "a photo of a red chair", "a photo of the wooden table", "this is a photo of a fire extinguisher", "eine Leiter am Zaun",
]
TEXTS = [
    "a photo of a chair", "a photo of a fire extinguisher", "A Photo Of A CHAIR", "chair", "größe, ΑΒΓ",
    "消火器 🧯", "a photo of a " + "wooden table and a red chair and " * 12,
]
SPECIAL = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"]


def make_tokenizer():
    """Gemma's: spaces become a letter, words are merged pairs of letters, unknown letters their bytes."""
    path = f"{OUT}/tokenizer.json"
    tokenizer = Tokenizer(models.BPE(unk_token="<unk>", fuse_unk=True, byte_fallback=True))
    tokenizer.normalizer = normalizers.Replace(" ", "\u2581")
    tokenizer.pre_tokenizer = pre_tokenizers.Split(Regex("(?=\u2581)"), "isolated")
    bytes_ = [f"<0x{byte:02X}>" for byte in range(256)]
    trainer = trainers.BpeTrainer(vocab_size=5 + 256 + 120, special_tokens=SPECIAL + bytes_, show_progress=False)
    tokenizer.train_from_iterator(LEARNT * 3, trainer)
    # Bytes are no special tokens in Gemma's file, and the split is one that no text needs: normalised texts
    # have no spaces.
    made = json.loads(tokenizer.to_str())
    made["added_tokens"] = made["added_tokens"][:len(SPECIAL)]
    tokenizer = Tokenizer.from_str(json.dumps(made))
    tokenizer.pre_tokenizer = pre_tokenizers.Split(" ", "merged_with_previous")
    tokenizer.decoder = decoders.Sequence([decoders.Replace("\u2581", " "), decoders.ByteFallback(), decoders.Fuse()])
    tokenizer.save(path)
    # Ends texts with <eos>, as Google's configuration of the class does, and keeps its padding and truncation
    # in the file.
    fast = GemmaTokenizerFast(tokenizer_file=path, add_bos_token=False, add_eos_token=True, padding_side="right")
    fast("", padding="max_length", max_length=N_TOKENS, truncation=True)
    fast.backend_tokenizer.save(path, pretty=False)
    return fast


class Vision(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model.vision_model

    def forward(self, pixel_values):
        out = self.model(pixel_values)
        return out.last_hidden_state, out.pooler_output


class Text(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model.text_model

    def forward(self, input_ids):
        out = self.model(input_ids)
        return out.last_hidden_state, out.pooler_output


def export(module, inputs, name, input_name):
    path = f"{OUT}/{name}.onnx"
    outputs = ["last_hidden_state", "pooler_output"]
    torch.onnx.export(module, inputs, path, opset_version=17, input_names=[input_name], output_names=outputs, dynamo=False,
                      dynamic_axes={name: {0: "batch_size"} for name in [input_name, *outputs]})
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


@torch.no_grad()
def main():
    os.makedirs(OUT, exist_ok=True)
    tokenizer = make_tokenizer()
    torch.manual_seed(17)
    side = {"hidden_size": DIM, "intermediate_size": 2 * DIM, "num_hidden_layers": 2, "num_attention_heads": 2}
    config = SiglipConfig(
        text_config=side | {"vocab_size": len(tokenizer), "max_position_embeddings": N_TOKENS, "projection_size": DIM},
        vision_config=side | {"image_size": SIZE, "patch_size": PATCH})
    config._attn_implementation = "eager"
    model = SiglipModel(config).eval()
    for parameter in model.parameters():
        parameter.copy_(torch.randn_like(parameter) * (0.3 if parameter.dim() > 1 else 0.2) + (parameter == 1))

    # Google's preprocessor: bilinear, stretched, levels from -1 to 1.
    processor = SiglipImageProcessor(
        size={"height": SIZE, "width": SIZE}, resample=Image.BILINEAR, image_mean=[0.5] * 3, image_std=[0.5] * 3)
    rng = np.random.default_rng(12)
    golden = {}
    photos = []
    for k, (width, height) in enumerate([(97, 61), (30, 75), (48, 48)]):
        blocks = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
        photos.append(Image.fromarray(blocks).resize((width, height), Image.BICUBIC))
        golden[f"image_{k}"] = np.asarray(photos[k])
    pixels = processor(photos, return_tensors="pt")["pixel_values"]
    vision = export(Vision(model), (pixels,), "vision_model", "pixel_values")
    image_embeds = model.get_image_features(pixels)
    found = vision.run(["pooler_output"], {"pixel_values": pixels.numpy()})[0]
    print("image", found.shape, np.abs(found - image_embeds.numpy()).max())

    encode = lambda texts: tokenizer(texts, padding="max_length", max_length=N_TOKENS, truncation=True, return_tensors="pt")
    # SigLIP 2 was trained on lower case, which its processor makes.
    lowered = [text.lower() for text in TEXTS]
    ids = encode(lowered)["input_ids"]
    text = export(Text(model), (ids,), "text_model", "input_ids")
    text_embeds = model.get_text_features(input_ids=ids)
    found = text.run(["pooler_output"], {"input_ids": ids.numpy()})[0]
    print("text", found.shape, np.abs(found - text_embeds.numpy()).max(), [int((row != 0).sum()) for row in ids])
    np.savez_compressed(
        f"{OUT}/golden.npz", pixel_values=pixels.numpy(), image_embeds=image_embeds.numpy(),
        text_embeds=text_embeds.numpy(), **golden)
    json.dump([{"text": text, "ids": row.tolist()} for text, row in zip(TEXTS, ids)],
              open(f"{OUT}/golden_tokens.json", "w"), ensure_ascii=False, separators=(",", ":"))


main()
