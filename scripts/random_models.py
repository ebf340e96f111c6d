"""Makes CLIP ViT-B/32 (image side) or Segment Anything ViT-B at full size with random weights, as ONNX: for
measurements of time alone. Names are those of the public exports.

usage: random_models.py FOLDER clip|sam
needs: torch, transformers (5), onnx
"""
import sys

import torch

folder, what = sys.argv[1:3]
torch.manual_seed(0)


class Clip(torch.nn.Module):
    def __init__(self):
        from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

        super().__init__()
        of = CLIPVisionModelWithProjection._from_config
        self.clip = of(CLIPVisionConfig(), attn_implementation="eager").eval()

    def forward(self, pixels):
        found = self.clip(pixels)
        return found.image_embeds, found.last_hidden_state


class SamEncoder(torch.nn.Module):
    def __init__(self, sam):
        super().__init__()
        self.sam = sam

    def forward(self, pixels):
        where = self.sam.get_image_wide_positional_embeddings()
        return self.sam.get_image_embeddings(pixels), where.repeat(pixels.shape[0], 1, 1, 1)


class SamDecoder(torch.nn.Module):
    def __init__(self, sam):
        super().__init__()
        self.sam = sam

    def forward(self, points, labels, embedding, where):
        sparse, dense = self.sam.prompt_encoder(
            input_points=points, input_labels=labels, input_boxes=None, input_masks=None
        )
        masks, scores = self.sam.mask_decoder(
            image_embeddings=embedding,
            image_positional_embeddings=where,
            sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense,
            multimask_output=True,
        )[:2]
        return scores, masks


def export(module, inputs, file, names, outputs, free):
    free = {name: {axis: label} for name, (axis, label) in free.items()}
    torch.onnx.export(
        module,
        inputs,
        f"{folder}/{file}",
        opset_version=17,
        dynamo=False,
        input_names=names,
        output_names=outputs,
        dynamic_axes=free,
    )


with torch.no_grad():
    if what == "clip":
        outputs = ["image_embeds", "last_hidden_state"]
        free = {name: (0, "batch_size") for name in ["pixel_values", *outputs]}
        export(Clip(), (torch.zeros(2, 3, 224, 224),), "vision_model.onnx", ["pixel_values"], outputs, free)
    else:
        from transformers import SamConfig, SamModel

        sam = SamModel._from_config(SamConfig(), attn_implementation="eager").eval()
        maps = ["image_embeddings", "image_positional_embeddings"]
        export(SamEncoder(sam), (torch.zeros(1, 3, 1024, 1024),), "vision_encoder.onnx", ["pixel_values"], maps, {})
        names, outputs = ["input_points", "input_labels", *maps], ["iou_scores", "pred_masks"]
        inputs = (
            torch.rand(1, 4, 1, 2) * 1024,
            torch.ones(1, 4, 1, dtype=torch.long),
            torch.rand(1, 256, 64, 64),
            torch.rand(1, 256, 64, 64),
        )
        free = {name: (1, "point_batch_size") for name in [*names[:2], *outputs]}
        export(SamDecoder(sam), inputs, "prompt_encoder_mask_decoder.onnx", names, outputs, free)
