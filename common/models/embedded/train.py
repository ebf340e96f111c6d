"""Trains the embedded encoders on crops of generated things, and reports how good they are.

usage: train.py OUT TEST_DIR TRAIN_DIR...     (folders of `slag-encoder generate crops`; see CARD.md)

Every text says something that is true or false of every crop: which noun, colour, material, kind of thing or
proportion it names is known exactly. So the loss is a sigmoid per pair of crop and text (SigLIP: Zhai et al.
2023), with softmax terms over nouns, colours and materials. The cosine at which the sigmoid passes 1/2 is the
threshold from which something counts as found.
"""

import argparse, json, math, pathlib, random, time

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors, trainers

EDGE, DIM, TOKENS, VOCABULARY = 64, 128, 16, 1024
COLOURS = "black white grey red green blue yellow orange brown purple pink".split()
MATERIALS = ("wood metal plastic fabric leather stone brick ceramic glass paper rubber leaf skin plaster tile").split()
MATERIAL_WORDS = {
    "wood": ["wooden", "wood"], "fabric": ["fabric", "cloth", "textile"], "leaf": ["leafy"], "ceramic": ["ceramic", "china"],
    "metal": ["metal", "steel", "metallic"], "stone": ["stone", "concrete"], "paper": ["paper", "cardboard"],
}
# Words that say nothing which a crop could show.
IDLE = ["big", "small", "large", "little", "old", "new", "nice", "closest", "nearest"]
PROMPTS = ["{}", "{}", "{}", "a {}", "the {}", "a photo of a {}", "find the {}", "where is the {}", "some {}", "my {}"]
# Things that are nowhere: a text that names one is false of every crop.
ABSENT = """elephant airplane helicopter boat ship submarine piano guitar violin drum-kit trumpet cat horse cow sheep pig
chicken duck bird eagle fish shark whale snake spider butterfly lion tiger bear wolf monkey giraffe zebra kangaroo penguin
dinosaur unicorn dragon robot rocket satellite moon sun cloud rainbow mountain volcano river lake waterfall beach island
bridge castle church temple tower skyscraper stadium windmill lighthouse pyramid statue fountain bathtub toilet shower
towel toothbrush soap comb razor perfume lipstick ring necklace bracelet crown hat helmet glove scarf coat jacket shirt
dress skirt sock shoe boot sandal tie belt wallet purse key lock chain rope wire cable plug battery microphone speaker
headphones camera telescope microscope binoculars calculator keyboard mouse printer telephone smartphone tablet radio
record player candle lantern torch match cigarette lighter knife fork spoon plate chopsticks pan blender toaster
microwave dishwasher freezer apple banana orange-fruit grape strawberry pear peach lemon melon pineapple tomato potato
carrot onion cabbage corn mushroom bread cake pizza hamburger sandwich cheese egg rice noodles soup chocolate candy
ice-cream coffee tea milk juice wine beer newspaper magazine letter stamp envelope pencil pen crayon eraser ruler scissors
glue tape stapler paintbrush hammer screwdriver wrench pliers saw drill axe nail screw rake hoe hose lawnmower
tennis-racket baseball-bat skateboard surfboard ski sled kite balloon doll teddy-bear puzzle dice chess playing-cards
train tram subway bus taxi ambulance fire-engine police-car tank-of-war scooter rollerblade canoe kayak sailboat anchor
net fishing-rod tombstone coffin gun sword bow arrow shield cannon bomb medal trophy flag money coin gold diamond crystal
swimming-pool trampoline swing slide carousel ferris-wheel roller-coaster hospital school bank theatre prison sand snow
ice fire smoke water cactus palm rose tulip sunflower pumpkin nest egg-carton cage aquarium beehive spider-web""".split()
ABSENT = [word.replace("-", " ") for word in ABSENT]


def plural(noun):
    if noun.endswith(("s", "x", "ch", "sh")):
        return noun if noun in ("stairs", "pipes", "bricks") else noun + "es"
    if noun.endswith("y") and noun[-2] not in "aeiou":
        return noun[:-1] + "ies"
    return noun[:-5] + "shelves" if noun.endswith("shelf") else noun + "s"


class Words:
    """What can be said, and of which crops it is true."""

    def __init__(self, nouns):
        self.nouns = nouns
        self.of_word, self.of_kind = {}, {}
        for i, noun in enumerate(nouns):
            for word in [noun["name"], *noun["words"]]:
                self.of_word.setdefault(word, set()).add(i)
            for kind in noun["kinds"]:
                self.of_kind.setdefault(kind, set()).add(i)
        # A kind's word may be a noun's word too (a container): what it names then is both.
        for word in set(self.of_word) & set(self.of_kind):
            self.of_word[word] |= self.of_kind[word]
            self.of_kind[word] = self.of_word[word]
        self.words_of = [[w for w, of in self.of_word.items() if i in of and len(of) <= 2] or [n["name"]]
                         for i, n in enumerate(nouns)]

    def sample(self, noun, colour, material, tall):
        """Returns a text, and what a crop must be for it to be true: (nouns, colour, material, tall)."""
        r = random.random()
        material_word = random.choice(MATERIAL_WORDS.get(material, [material]))
        if r < 0.08:
            return random.choice([colour, f"something {colour}", f"{colour} thing", f"{colour} object",
                                  f"anything {colour}"]), (None, colour, None, None)
        if r < 0.13:
            text = random.choice([material_word, f"something made of {material}", f"{material_word} thing", f"something {material_word}"])
            return text, (None, None, material, None)
        if r < 0.24:
            kind = random.choice(self.nouns[noun]["kinds"])
            of = self.of_kind[kind]
            some = kind.startswith("some")
            if random.random() < 0.3:
                text = kind.replace("something", f"something {colour}") if some else f"{colour} {kind}"
                return text, (of, colour, None, None)
            return kind if some else random.choice([kind, f"a {kind}", plural(kind)]), (of, None, None, None)
        word = random.choice(self.words_of[noun])
        of = self.of_word[word]
        said = [None, None, None]
        adjectives = []
        if random.random() < 0.5:
            adjectives.append(colour)
            said[0] = colour
        if random.random() < 0.25:
            adjectives.append(material_word)
            said[1] = material
        if tall is not None and random.random() < 0.25:
            adjectives.append(random.choice(["tall", "high", "slender"] if tall else ["low", "short", "flat"]))
            said[2] = tall
        if random.random() < 0.1:
            adjectives.append(random.choice(IDLE))
        random.shuffle(adjectives)
        phrase = " ".join([*adjectives, plural(word) if random.random() < 0.15 else word])
        if random.random() < 0.1 and said[0] and len(adjectives) == 1:
            phrase = f"{word} that is {colour}"
        return random.choice(PROMPTS).format(phrase), (of, *said)

    def absent(self):
        adjective = random.choice(["", "", *(c + " " for c in COLOURS)])
        return random.choice(PROMPTS).format(adjective + random.choice(ABSENT)), (set(), None, None, None)


def train_tokenizer(words, seed):
    random.seed(seed)
    corpus = [words.absent()[0] for _ in range(6000)]
    for _ in range(40000):
        noun = random.randrange(len(words.nouns))
        corpus.append(words.sample(noun, random.choice(COLOURS), random.choice(MATERIALS), random.choice([None, True, False]))[0])
    tokenizer = Tokenizer(models.BPE(unk_token=None, byte_fallback=False))
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Lowercase(), normalizers.Replace("-", " ")])
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([pre_tokenizers.Punctuation("removed"), pre_tokenizers.ByteLevel(add_prefix_space=True)])
    tokenizer.train_from_iterator(corpus, trainers.BpeTrainer(
        vocab_size=VOCABULARY, special_tokens=["<end>"], initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False))
    tokenizer.post_processor = processors.TemplateProcessing(single="$A <end>", special_tokens=[("<end>", 0)])
    return tokenizer


class Residual(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU(),
                                    nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x):
        return F.relu(x + self.layers(x))


class ImageEncoder(nn.Module):
    """[n, 3, 64, 64], (level / 255 - 0.5) / 0.5 -> [n, 128], unit length."""

    def __init__(self, widths=(24, 48, 96, 192), depths=(0, 1, 2, 1)):
        super().__init__()
        layers, before = [], 3
        for width, depth in zip(widths, depths):
            layers += [nn.Conv2d(before, width, 3, stride=2, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU()]
            layers += [Residual(width) for _ in range(depth)]
            before = width
        self.layers = nn.Sequential(*layers)
        self.head = nn.Linear(4 * before, DIM)

    def forward(self, pixels):
        x = self.layers(pixels)
        # Four quarters, so that top and bottom, left and right stay apart.
        x = F.avg_pool2d(x, 2).flatten(1)
        return F.normalize(self.head(x), dim=-1)


class TextEncoder(nn.Module):
    """[n, tokens] ids, the last one <end> -> [n, 128], unit length."""

    def __init__(self, width=96, depth=2, heads=4):
        super().__init__()
        self.tokens = nn.Embedding(VOCABULARY, width)
        self.places = nn.Parameter(0.02 * torch.randn(TOKENS, width))
        self.blocks = nn.ModuleList(nn.ModuleDict({
            "norm1": nn.LayerNorm(width), "qkv": nn.Linear(width, 3 * width), "out": nn.Linear(width, width),
            "norm2": nn.LayerNorm(width), "up": nn.Linear(width, 3 * width), "down": nn.Linear(3 * width, width)})
            for _ in range(depth))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, DIM)
        self.heads = heads

    def forward(self, ids, lengths=None):
        n, length = ids.shape
        x = self.tokens(ids) + self.places[:length]
        bias = None
        if lengths is not None:
            bias = torch.zeros(n, 1, 1, length, device=ids.device).masked_fill(
                torch.arange(length, device=ids.device)[None, None, None] >= lengths[:, None, None, None], -1e4)
        for block in self.blocks:
            q, k, v = block["qkv"](block["norm1"](x)).reshape(n, length, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
            scores = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])
            attended = (scores if bias is None else scores + bias).softmax(-1) @ v
            x = x + block["out"](attended.transpose(1, 2).reshape(n, length, -1))
            x = x + block["down"](F.gelu(block["up"](block["norm2"](x))))
        end = x[:, -1] if lengths is None else x[torch.arange(n, device=ids.device), lengths - 1]
        return F.normalize(self.head(self.norm(end)), dim=-1)


class Data:
    def __init__(self, folders, tall_of=None):
        self.nouns = json.loads((pathlib.Path(folders[0]) / "nouns.json").read_text())
        self.pixels = [np.load(pathlib.Path(f) / "crops.npy", mmap_mode="r") for f in folders]
        labels = [label for f in folders for label in json.loads((pathlib.Path(f) / "labels.json").read_text())]
        self.place = [(f, i) for f, pixels in enumerate(self.pixels) for i in range(len(pixels))]
        self.noun = np.array([label["noun"] for label in labels])
        self.colour = np.array([COLOURS.index(label["colour"]) for label in labels])
        self.material = np.array([MATERIALS.index(label["material"]) for label in labels])
        self.held_out = np.array([label["held_out"] for label in labels])
        self.whole = np.array([not label["cut"] and label["shown"] > 0.6 for label in labels])
        slender = np.array([label["slenderness"] for label in labels])
        if tall_of is None:
            tall_of = {}
            for noun in range(len(self.nouns)):
                of = slender[self.noun == noun]
                if len(of) > 20:
                    low, high = np.quantile(of, [1 / 3, 2 / 3])
                    if high > 1.15 * low:
                        tall_of[noun] = (low, high)
        self.tall_of = tall_of
        limits = np.array([tall_of.get(noun, (-1.0, math.inf)) for noun in range(len(self.nouns))])
        self.tall = np.where(slender > limits[self.noun, 1], 1, np.where(slender < limits[self.noun, 0], 0, -1))

    def images(self, index):
        return torch.from_numpy(np.stack([self.pixels[f][i] for f, i in (self.place[k] for k in index)])).permute(0, 3, 1, 2)


def augment(images):
    """Light, colour cast, sharpness and noise as photos differ in them; mirrored."""
    n = len(images)
    white = (images.amin(1, keepdim=True) == 255)
    x = images.float() / 255
    gain = 1 + 0.15 * (2 * torch.rand(n, 1, 1, 1) - 1) + 0.05 * (2 * torch.rand(n, 3, 1, 1) - 1)
    x = (x * gain + 0.06 * (2 * torch.rand(n, 1, 1, 1) - 1) + 0.02 * torch.randn_like(x)).clamp(0, 1)
    soft = torch.rand(n) < 0.35
    if soft.any():
        size = random.choice([24, 32, 44])
        x[soft] = F.interpolate(F.interpolate(x[soft], size=size, mode="area"), size=EDGE, mode="bilinear")
    x = torch.where(white, torch.ones(()), x)
    flip = torch.rand(n) < 0.5
    x[flip] = x[flip].flip(-1)
    return (x - 0.5) / 0.5


def encode_texts(model, tokenizer, texts, device):
    ids = [tokenizer.encode(text).ids for text in texts]
    ids = [i if len(i) <= TOKENS else i[:TOKENS - 1] + [0] for i in ids]
    lengths = torch.tensor([len(i) for i in ids], device=device)
    padded = torch.zeros(len(ids), int(lengths.max()), dtype=torch.long)
    for row, i in zip(padded, ids):
        row[:len(i)] = torch.tensor(i)
    return model(padded.to(device), lengths)


def truth_of(said, data, index, words):
    """Returns [crops, texts]: 1 true, 0 false, -1 unknown."""
    truth = np.ones((len(index), len(said)), np.int8)
    noun, colour, material, tall = (a[index] for a in (data.noun, data.colour, data.material, data.tall))
    for t, (of, c, m, high) in enumerate(said):
        true = np.ones(len(index), bool)
        if of is not None:
            true &= np.isin(noun, list(of))
        if c is not None:
            true &= colour == COLOURS.index(c)
        if m is not None:
            true &= material == MATERIALS.index(m)
        truth[:, t] = true
        if high is not None:
            truth[true & (tall != int(high)), t] = 0
            truth[true & (tall == -1), t] = -1
    return truth


def train(args, data, words, tokenizer):
    device = args.device
    torch.manual_seed(args.seed); random.seed(args.seed); np.random.seed(args.seed)
    image, text = ImageEncoder().to(device), TextEncoder().to(device)
    if device == "cpu":
        image = image.to(memory_format=torch.channels_last)
    scale, bias = nn.Parameter(torch.tensor(math.log(12.0), device=device)), nn.Parameter(torch.tensor(-7.0, device=device))
    groups = [{"params": [*image.parameters(), *text.parameters()], "weight_decay": 0.02}, {"params": [scale, bias], "weight_decay": 0.0}]
    optimiser = torch.optim.AdamW(groups, lr=args.rate, betas=(0.9, 0.98))
    counts = np.bincount(data.noun, minlength=len(data.nouns))
    chance = 1 / np.sqrt(counts[data.noun])
    chance /= chance.sum()
    began = time.time()
    step, mean = 0, None
    while True:
        # Time decides how long, so that the rate can reach 0 on any machine; the card states the steps made.
        done = min(1.0, (time.time() - began) / args.seconds) if args.seconds else step / args.steps
        if done >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = args.rate * min(1, (step + 1) / 200) * (0.5 + 0.5 * math.cos(math.pi * done))
        index = np.random.choice(len(chance), args.batch, p=chance)
        pixels = augment(data.images(index)).to(device)
        if device == "cpu":
            pixels = pixels.contiguous(memory_format=torch.channels_last)
        said, texts = [], []
        for k in np.random.choice(index, args.texts):
            tall = {1: True, 0: False, -1: None}[int(data.tall[k])]
            other = random.random() < 0.25
            chosen = words.sample(int(data.noun[k]), random.choice(COLOURS) if other else COLOURS[data.colour[k]],
                                  MATERIALS[data.material[k]], tall)
            if random.random() < 0.08:
                chosen = words.absent()
            texts.append(chosen[0]); said.append(chosen[1])
        # The softmax terms: one text of each noun, colour and material.
        noun_words = [random.choice(of) for of in words.words_of]
        noun_texts = [random.choice(PROMPTS).format(word) for word in noun_words]
        colour_texts = [random.choice(["{}", "something {}", "{} thing"]).format(c) for c in COLOURS]
        material_texts = [random.choice(["something {}", "{} thing", "{}"]).format(random.choice(MATERIAL_WORDS.get(m, [m]))) for m in MATERIALS]
        truth = torch.from_numpy(truth_of(said, data, index, words)).to(device)
        with torch.autocast(device, dtype=torch.bfloat16):
            x = image(pixels)
            y = encode_texts(text, tokenizer, texts + noun_texts + colour_texts + material_texts, device)
        cosines = x.float() @ y.float().T
        pairs = cosines[:, :len(texts)] * scale.exp() + bias
        known = truth >= 0
        loss = F.binary_cross_entropy_with_logits(pairs[known], truth[known].float(), reduction="sum") / args.batch
        logits = cosines[:, len(texts):] * 16
        nouns, colours, materials = logits.split([len(noun_texts), len(COLOURS), len(MATERIALS)], dim=1)
        noun = torch.from_numpy(data.noun[index]).to(device)
        also = torch.from_numpy(np.stack([[n in words.of_word[w] for w in noun_words] for n in data.noun[index]])).to(device)
        also[torch.arange(len(noun)), noun] = False
        softmax = F.cross_entropy(nouns.masked_fill(also, -1e4), noun)
        softmax = softmax + 0.4 * F.cross_entropy(colours, torch.from_numpy(data.colour[index]).to(device))
        softmax = softmax + 0.4 * F.cross_entropy(materials, torch.from_numpy(data.material[index]).to(device))
        total = 0.25 * loss + softmax
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_([*image.parameters(), *text.parameters()], 1.0)
        optimiser.step()
        step += 1
        now = np.array([loss.item(), softmax.item(), (nouns.argmax(1) == noun).float().mean().item()])
        mean = now if mean is None else 0.98 * mean + 0.02 * now
        if step % 100 == 0:
            print(f"{step} {time.time() - began:.0f} s  pairs {mean[0]:.3f}  softmax {mean[1]:.3f}  noun {mean[2]:.3f}", flush=True)
            if args.checkpoint:
                torch.save([image.state_dict(), text.state_dict(), scale, bias], args.checkpoint)
    return image.eval(), text.eval(), float(scale.exp()), float(bias), step


@torch.no_grad()
def evaluate(image, text, tokenizer, data, words, scale, bias, device):
    x = torch.cat([image(((data.images(range(i, min(i + 512, len(data.place)))).float() / 255 - 0.5) / 0.5).to(device)).cpu()
                   for i in range(0, len(data.place), 512)])
    encode = lambda texts: encode_texts(text, tokenizer, texts, device).cpu()
    nouns = x @ encode([f"a {n['name']}" for n in data.nouns]).T
    colours = x @ encode([f"something {c}" for c in COLOURS]).T
    materials = x @ encode([f"something made of {m}" for m in MATERIALS]).T
    top1 = nouns.argmax(1).numpy() == data.noun
    # A crop of the noun asked for: which of its colours?
    pairs = encode([f"{c} {n['name']}" for n in data.nouns for c in COLOURS]).reshape(len(data.nouns), len(COLOURS), DIM)
    of_noun = torch.einsum("nd,ncd->nc", x, pairs[data.noun]).argmax(1).numpy() == data.colour
    found = lambda mask, right: float(right[mask].mean()) if mask.any() else None
    colour = colours.argmax(1).numpy() == data.colour
    material = materials.argmax(1).numpy() == data.material
    shells = np.isin(data.noun, [i for i, n in enumerate(data.nouns) if n["name"] in ("floor", "wall", "ceiling", "grass", "road", "pavement")])
    groups = {"all": np.ones(len(top1), bool), "whole": data.whole, "cut or hidden": ~data.whole,
              "held-out pairs": data.held_out, "held-out pairs, whole": data.held_out & data.whole, "without floors and walls, whole": data.whole & ~shells}
    report = {"crops": len(top1), "threshold": -bias / scale, "groups": {}, "nouns": {}}
    for name, mask in groups.items():
        report["groups"][name] = {"crops": int(mask.sum()), "noun top-1": found(mask, top1), "colour top-1": found(mask, colour),
                                  "colour of the noun top-1": found(mask, of_noun), "material top-1": found(mask, material)}
    predicted = nouns.argmax(1).numpy()
    confusion = np.zeros((len(data.nouns),) * 2)
    np.add.at(confusion, (data.noun[data.whole], predicted[data.whole]), 1)
    for i, noun in enumerate(data.nouns):
        mask = (data.noun == i) & data.whole
        wrong = [(data.nouns[j]["name"], int(confusion[i, j])) for j in np.argsort(-confusion[i])[:4] if j != i and confusion[i, j] > 0]
        report["nouns"][noun["name"]] = {"crops": int(mask.sum()), "top-1": found(mask, top1), "taken for": wrong[:3]}
    # Found or not: texts of what is there against texts of what is nowhere.
    absent = x @ encode([f"a {word}" for word in ABSENT]).T
    own = nouns[torch.arange(len(x)), torch.from_numpy(data.noun)]
    threshold = -bias / scale
    report["found"] = {"own noun above the threshold": float((own > threshold).float().mean()),
                       "absent nouns above the threshold": float((absent > threshold).float().mean()),
                       "other nouns above the threshold": float(((nouns > threshold).float().sum() - (own > threshold).float().sum()) / (nouns.numel() - len(own)))}
    return report, confusion


def export(out, image, text, tokenizer):
    out.mkdir(parents=True, exist_ok=True)
    image, text = image.cpu().to(memory_format=torch.contiguous_format), text.cpu()
    torch.onnx.export(image, (torch.zeros(2, 3, EDGE, EDGE),), out / "image.onnx", input_names=["pixel_values"], output_names=["image_embeds"],
                      dynamic_axes={"pixel_values": {0: "n"}, "image_embeds": {0: "n"}}, opset_version=17, dynamo=False)
    torch.onnx.export(text, (torch.zeros(2, 5, dtype=torch.long),), out / "text.onnx", input_names=["input_ids"], output_names=["text_embeds"],
                      dynamic_axes={"input_ids": {0: "n", 1: "tokens"}, "text_embeds": {0: "n"}}, opset_version=17, dynamo=False)
    tokenizer.save(str(out / "tokenizer.json"), pretty=False)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("test")
    parser.add_argument("train", nargs="*")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=20000)
    parser.add_argument("--seconds", type=float, default=0, help="stop after this time instead")
    parser.add_argument("--batch", type=int, default=192)
    parser.add_argument("--texts", type=int, default=256)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--checkpoint", help="kept while training; evaluated and exported instead, where no folder to train with is given")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    tall_of = None
    if args.train:
        data = Data(args.train)
        words, tall_of = Words(data.nouns), data.tall_of
        tokenizer = train_tokenizer(words, args.seed)
        print(f"{len(data.place)} crops, {len(data.nouns)} nouns, {tokenizer.get_vocab_size()} tokens, on {args.device}", flush=True)
        image, text, scale, bias, steps = train(args, data, words, tokenizer)
    else:
        image, text = ImageEncoder(), TextEncoder()
        states = torch.load(args.checkpoint, map_location="cpu")
        image.load_state_dict(states[0]); text.load_state_dict(states[1])
        image.eval(); text.eval()
        scale, bias, steps, args.device = float(states[2].exp()), float(states[3]), 0, "cpu"
        words = Words(Data([args.test]).nouns)
        tokenizer = train_tokenizer(words, args.seed)
    test = Data([args.test], tall_of)
    report, confusion = evaluate(image, text, tokenizer, test, words, scale, bias, args.device)
    report |= {"scale": scale, "bias": bias, "steps": steps, "batch": args.batch, "seed": args.seed, "device": args.device, "torch": torch.__version__}
    (args.out / "report.json").write_text(json.dumps(report, indent=1))
    print(json.dumps({k: v for k, v in report.items() if k != "nouns"}, indent=1))
    export(args.out, image, text, tokenizer)
    from PIL import Image
    grey = 255 - np.sqrt(confusion / np.maximum(confusion.sum(1, keepdims=True), 1)) * 255
    Image.fromarray(grey.astype(np.uint8)).resize((8 * len(confusion),) * 2, 0).save(args.out / "confusion.png")


if __name__ == "__main__":
    main()
