"""Times CLIP ViT-B/32 and SAM ViT-B with random weights in PyTorch (16 bits), and given ONNX files in Python's onnxruntime.

usage: python -c SCRIPT '{"image": FILE or null, "encoder": FILE or null, "decoder": FILE or null, "batch": N,
"grids": [N], "points_per_batch": N, "secs": S}'. Prints one JSON object. Inputs lie on the GPU, and masks stay there.
needs: torch, transformers (5), numpy, onnxruntime-gpu
"""
import json
import sys
import time

asked = json.loads(sys.argv[1])
on_gpu = asked.get("device", "cuda") == "cuda"
found = {}


def rate(step, per_step, sync):
    for _ in range(3):
        step()
    sync()
    start, n = time.perf_counter(), 0
    while time.perf_counter() - start < asked["secs"]:
        step()
        n += 1
        # The queue of kernels must not grow without bounds.
        if n % 4 == 0:
            sync()
    sync()
    return n * per_step / (time.perf_counter() - start)


def with_torch():
    import torch
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection, SamConfig, SamModel

    device, kind = ("cuda", torch.float16) if on_gpu else ("cpu", torch.float32)
    sync = torch.cuda.synchronize if on_gpu else lambda: None
    torch.manual_seed(0)
    with torch.inference_mode():
        if asked["image"]:
            clip = CLIPVisionModelWithProjection(CLIPVisionConfig()).eval().to(device, kind)
            pixels = torch.randn(asked["batch"], 3, 224, 224, device=device, dtype=kind)
            found["torch_crops_per_sec"] = rate(lambda: clip(pixels).image_embeds, asked["batch"], sync)
            del clip, pixels
        if asked["encoder"]:
            sam = SamModel(SamConfig()).eval().to(device, kind)
            photo = torch.randn(1, 3, 1024, 1024, device=device, dtype=kind)
            n = asked["points_per_batch"]
            where = sam.get_image_wide_positional_embeddings().to(kind)

            def image(n_points):
                embedding = sam.get_image_embeddings(photo)
                for _ in range(0, n_points, n):
                    points = torch.rand(1, n, 1, 2, device=device, dtype=kind) * 1024
                    labels = torch.ones(1, n, 1, device=device, dtype=torch.long)
                    sparse, dense = sam.prompt_encoder(points, labels, None, None)
                    sam.mask_decoder(
                        image_embeddings=embedding,
                        image_positional_embeddings=where,
                        sparse_prompt_embeddings=sparse,
                        dense_prompt_embeddings=dense,
                        multimask_output=True,
                    )

            for grid in asked["grids"]:
                found[f"torch_images_per_sec_grid_{grid}"] = rate(lambda: image(grid * grid), 1, sync)


def with_onnxruntime():
    import numpy as np
    import onnxruntime as ort

    place = "cuda" if on_gpu else "cpu"
    providers = ["CUDAExecutionProvider"] if on_gpu else ["CPUExecutionProvider"]
    types = {"tensor(float16)": np.float16, "tensor(float)": np.float32}

    def opened(path):
        session = ort.InferenceSession(path, providers=providers)
        assert session.get_providers()[0] == providers[0], session.get_providers()
        return session

    def value(array):
        return ort.OrtValue.ortvalue_from_numpy(np.ascontiguousarray(array), place, 0)

    def pixels(session, shape):
        of = session.get_inputs()[0]
        return of.name, value(np.random.default_rng(0).standard_normal(shape).astype(types[of.type]))

    if asked["image"]:
        session = opened(asked["image"])
        name, input_value = pixels(session, (asked["batch"], 3, 224, 224))
        output = next(o.name for o in session.get_outputs() if len(o.shape) == 2)

        def crops():
            binding = session.io_binding()
            binding.bind_ortvalue_input(name, input_value)
            binding.bind_output(output, "cpu")
            session.run_with_iobinding(binding)

        found["onnxruntime_crops_per_sec"] = rate(crops, asked["batch"], lambda: None)
        del session, input_value
    if asked["encoder"]:
        encoder, decoder = opened(asked["encoder"]), opened(asked["decoder"])
        name, input_value = pixels(encoder, (1, 3, 1024, 1024))
        offered = [o.name for o in encoder.get_outputs()]
        n = asked["points_per_batch"]
        points = next(i for i in decoder.get_inputs() if i.type != "tensor(int64)" and i.name not in offered)
        labels = next(i for i in decoder.get_inputs() if i.type == "tensor(int64)")

        def image(n_points):
            binding = encoder.io_binding()
            binding.bind_ortvalue_input(name, input_value)
            for output in offered:
                binding.bind_output(output, place)
            encoder.run_with_iobinding(binding)
            embedding = dict(zip(offered, binding.get_outputs()))
            for _ in range(0, n_points, n):
                at = value(np.random.rand(1, n, 1, 2).astype(types[points.type]) * 1024)
                inside = value(np.ones((1, n, 1), np.int64))
                binding = decoder.io_binding()
                binding.bind_ortvalue_input(points.name, at)
                binding.bind_ortvalue_input(labels.name, inside)
                for output, tensor in embedding.items():
                    binding.bind_ortvalue_input(output, tensor)
                for output in decoder.get_outputs():
                    binding.bind_output(output.name, place)
                decoder.run_with_iobinding(binding)

        for grid in asked["grids"]:
            found[f"onnxruntime_images_per_sec_grid_{grid}"] = rate(lambda: image(grid * grid), 1, lambda: None)


for part in (with_onnxruntime, with_torch):
    try:
        part()
    except Exception as error:
        found.setdefault("failed", {})[part.__name__] = repr(error)[:500]
print(json.dumps(found))
