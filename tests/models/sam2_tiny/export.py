"""Writes SAM 2.1's architecture with small random weights, as its public ONNX exports lay it out, and what PyTorch
computes with it. Its masks mean nothing; the code path is the real one.

    export.py OUT        # vision_encoder.onnx(+_data), prompt_encoder_mask_decoder.onnx(+_data), golden.npz

Needs torch 2.4.1, transformers 4.57.1, onnx 1.17, onnxruntime, numpy and Pillow. The seed is fixed.
"""
import os
import sys
import warnings

import numpy as np
import onnx
import onnxruntime
import torch
from PIL import Image
from transformers import Sam2Config, Sam2HieraDetConfig, Sam2MaskDecoderConfig, Sam2Model
from transformers import Sam2PromptEncoderConfig, Sam2VisionConfig

warnings.filterwarnings("ignore")
OUT = sys.argv[1]
SIZE = 256  # pixels of the input square; the trained models have 1024
DIM = 16  # channels of the coarsest feature map; the trained models have 256
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


def make_model():
    torch.manual_seed(21)
    backbone = Sam2HieraDetConfig(
        hidden_size=4, num_attention_heads=1, image_size=[SIZE, SIZE], blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[4, 8, 16, 32], num_attention_heads_per_stage=[1, 2, 2, 4],
        window_size_per_stage=[8, 4, 14, 7], global_attention_blocks=[3], mlp_ratio=2.0)
    vision = Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[32, 16, 8, 4], fpn_hidden_size=DIM,
        backbone_feature_sizes=[[SIZE // 4] * 2, [SIZE // 8] * 2, [SIZE // 16] * 2])
    prompts = Sam2PromptEncoderConfig(hidden_size=DIM, image_size=SIZE, patch_size=16, mask_input_channels=4)
    decoder = Sam2MaskDecoderConfig(hidden_size=DIM, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=16)
    config = Sam2Config(vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    config._attn_implementation = "eager"
    model = Sam2Model(config).eval()
    # Larger weights, so that prompts and places show in the masks.
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter) * (0.3 if parameter.dim() > 1 else 0.1) + (parameter == 1))
        model.shared_image_embedding.positional_embedding.normal_()
        model._tie_weights()
        model.prompt_encoder.shared_embedding.positional_embedding.copy_(
            model.shared_image_embedding.positional_embedding)
    return model


class VisionEncoder(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixel_values):
        maps, *_ = self.model.get_image_features(pixel_values)
        maps[-1] = maps[-1] + self.model.no_memory_embedding
        sizes = self.model.backbone_feature_sizes
        return tuple(m.permute(1, 2, 0).reshape(-1, m.shape[2], *size) for m, size in zip(maps, sizes))


class MaskDecoder(torch.nn.Module):
    """Prompt encoder and mask decoder: one prompt an image, of points and at most one box."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, input_points, input_labels, input_boxes, fine, middle, coarse):
        model, encoder = self.model, self.model.prompt_encoder
        # A padding point closes the points, as in the reference; boxes follow as two corners each.
        points = encoder._embed_points(input_points, input_labels, pad=True)
        corners = input_boxes.reshape(input_boxes.shape[0], 1, -1, 2) + 0.5
        corners = encoder.shared_embedding(corners, (SIZE, SIZE))
        order = torch.arange(corners.shape[2]) % 2
        corners = corners + encoder.point_embed.weight[2:4][order]
        sparse = torch.cat([points, corners], dim=2)
        side = SIZE // 16
        dense = encoder.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(coarse.shape[0], -1, side, side)
        positions = model.get_image_wide_positional_embeddings().expand(coarse.shape[0], -1, -1, -1)
        masks, scores, _, objects = model.mask_decoder(
            image_embeddings=coarse, image_positional_embeddings=positions, sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense, multimask_output=True, high_resolution_features=[fine, middle])
        return scores, masks, objects


def shorten(graph, short):
    """Replaces the names of nodes and inner tensors, which make up half of a small file, and drops unused
    weights."""
    def rename(name):
        return short.setdefault(name, f"t{len(short)}") if name else name

    used = set()
    for k, node in enumerate(graph.node):
        node.name = f"n{k}"
        node.input[:] = [rename(name) for name in node.input]
        node.output[:] = [rename(name) for name in node.output]
        used.update(node.input)
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.GRAPH:
                used.update(shorten(attribute.g, short))
    for tensor in [*graph.initializer, *graph.output]:
        tensor.name = rename(tensor.name)
    used.update(tensor.name for tensor in graph.output)
    del graph.value_info[:]
    weights = [tensor for tensor in graph.initializer if tensor.name in used]
    del graph.initializer[:]
    graph.initializer.extend(weights)
    return used


def export(module, inputs, name, inputs_names, outputs, dynamic):
    path = f"{OUT}/{name}.onnx"
    torch.onnx.export(module, inputs, path, opset_version=17, input_names=inputs_names, output_names=outputs,
                      dynamic_axes=dynamic, dynamo=False)
    model = onnx.load(path)
    os.remove(path)
    shorten(model.graph, {name: name for name in [*inputs_names, *outputs]})
    # Weights beside the graph, as the public exports keep them.
    onnx.save(model, path, save_as_external_data=True, all_tensors_to_one_file=True, location=f"{name}.onnx_data",
              size_threshold=2048)
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


@torch.no_grad()
def main():
    model = make_model()
    embeddings = [f"image_embeddings.{k}" for k in range(3)]
    grid = [((x + 0.5) / 3 * SIZE, (y + 0.5) / 3 * SIZE) for y in range(3) for x in range(3)]
    rng = np.random.default_rng(3)
    blocks = rng.integers(0, 256, (7, 9, 3), dtype=np.uint8)
    photo = np.asarray(Image.fromarray(blocks).resize((101, 67), Image.BICUBIC))
    square = np.asarray(Image.fromarray(photo).resize((SIZE, SIZE), Image.BILINEAR))
    pixels = torch.from_numpy(((square / 255 - MEAN) / STD).astype(np.float32).transpose(2, 0, 1)[None].copy())

    maps = model.get_image_embeddings(pixels)
    # Half of the prompts shall show no object.
    head = model.mask_decoder.pred_obj_score_head.proj_out
    ask = lambda x, y: model(image_embeddings=list(maps), input_points=torch.tensor([[[[x, y]]]]),
                             input_labels=torch.ones((1, 1, 1), dtype=torch.int64), multimask_output=True)
    head.bias -= torch.stack([ask(x, y).object_score_logits for x, y in grid]).median() + 0.01

    batch = {0: "batch_size"}
    encoder = export(VisionEncoder(model), (pixels,), "vision_encoder", ["pixel_values"], embeddings,
                     {name: batch for name in ["pixel_values", *embeddings]})
    found = encoder.run(None, {"pixel_values": pixels.numpy()})
    print("encoder", [m.shape for m in found], max(np.abs(a - b.numpy()).max() for a, b in zip(found, maps)))

    points = torch.tensor([[[[40.0, 60.0]]]])
    labels = torch.ones((1, 1, 1), dtype=torch.int64)
    names = ["input_points", "input_labels", "input_boxes", *embeddings]
    dynamic = {name: dict(batch) for name in names}
    dynamic["input_points"][2] = dynamic["input_labels"][2] = "num_points_per_image"
    dynamic["input_boxes"][1] = "num_boxes_per_image"
    dynamic |= {name: batch for name in ["iou_scores", "pred_masks", "object_score_logits"]}
    decoder = export(MaskDecoder(model), (points, labels, torch.zeros(1, 1, 4), *maps), "prompt_encoder_mask_decoder",
                     names, ["iou_scores", "pred_masks", "object_score_logits"], dynamic)

    # Goldens are PyTorch's whole model, one prompt at a time, without boxes.
    scores, masks, objects = [], [], []
    for x, y in grid:
        points = torch.tensor([[[[x, y]]]])
        out = ask(x, y)
        feeds = dict(zip(names, [points.numpy(), labels.numpy(), np.zeros((1, 0, 4), np.float32)]))
        feeds |= {name: m.numpy() for name, m in zip(embeddings, maps)}
        found = decoder.run(None, feeds)
        expected = [out.iou_scores, out.pred_masks, out.object_score_logits]
        print("decoder", max(np.abs(a - b.numpy()).max() for a, b in zip(found, expected)), found[2].ravel(),
              (found[1] > 0).mean(axis=(0, 1, 3, 4)), found[0].ravel())
        scores.append(out.iou_scores.numpy()[0, 0])
        masks.append(out.pred_masks.numpy()[0, 0])
        objects.append(out.object_score_logits.numpy()[0, 0])
    masks = np.stack(masks)
    # What the reference's post-processing makes of the first prompt: masks go to the photo's size in one step.
    enlarged = torch.nn.functional.interpolate(
        torch.from_numpy(masks[:1, :].reshape(1, 3, *masks.shape[-2:])), photo.shape[:2], mode="bilinear",
        align_corners=False).numpy()[0]
    np.savez_compressed(
        f"{OUT}/golden.npz", image=photo, pixel_values_sub8=pixels.numpy()[0, :, ::8, ::8],
        points=np.array(grid, np.float32), iou_scores=np.stack(scores), object_score_logits=np.stack(objects),
        pred_masks_sub4=masks[:, :, ::4, ::4], first_masks_enlarged_sub3=enlarged[:, ::3, ::3],
        **{f"embedding_{k}_sub8": m.numpy()[0, :, ::8, ::8] for k, m in enumerate(maps)})


main()
