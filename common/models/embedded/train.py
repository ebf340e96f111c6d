"""Trains the embedded encoders on crops of generated things, and reports how good they are.

usage: train.py OUT TEST_DIR TRAIN_DIR...     (folders of `slag-lab generate crops`; see CARD.md)

Crops are generated, so it is known whether a text (a noun, colour, material, kind of thing or proportion) is true
of each crop. The loss is therefore a sigmoid per pair of crop and text (SigLIP: Zhai et al. 2023), with softmax
terms over nouns, colours and materials. The cosine where the sigmoid reaches 1/2 is the threshold for "found".
"""

import argparse, copy, json, math, pathlib, random, time

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
# Words that a crop cannot show.
IDLE = ["big", "small", "large", "little", "old", "new", "nice", "closest", "nearest"]
PROMPTS = ["{}", "{}", "{}", "a {}", "the {}", "a photo of a {}", "find the {}", "where is the {}", "some {}", "my {}"]
# Things that are in no crop: texts that name them are false everywhere.
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
    """The texts, and the crops that each is true of."""

    def __init__(self, nouns):
        self.nouns = nouns
        self.of_word, self.of_kind = {}, {}
        for i, noun in enumerate(nouns):
            for word in [noun["name"], *noun["words"]]:
                self.of_word.setdefault(word, set()).add(i)
            for kind in noun["kinds"]:
                self.of_kind.setdefault(kind, set()).add(i)
        # A word may name both a kind and a noun (container): it then stands for both.
        for word in set(self.of_word) & set(self.of_kind):
            self.of_word[word] |= self.of_kind[word]
            self.of_kind[word] = self.of_word[word]
        self.words_of = [[w for w, of in self.of_word.items() if i in of and len(of) <= 2] or [n["name"]]
                         for i, n in enumerate(nouns)]

    def sample(self, noun, colour, material, tall):
        """Returns a text and the (nouns, colour, material, tall) that make it true."""
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

    def __init__(self, widths=(24, 48, 96, 192), depths=(1, 2, 3, 1)):
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
        # Pooled by quarters, which keeps top and bottom, left and right apart.
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
        self.noun = np.array([label["noun"] for label in labels])
        self.colour = np.array([COLOURS.index(label["colour"]) for label in labels])
        self.material = np.array([MATERIALS.index(label["material"]) for label in labels])
        self.held_out = np.array([label["held_out"] for label in labels])
        self.segmented = np.array([label["segmented"] for label in labels])
        self.whole = np.array([not label["cut"] and not label["segmented"] and label["shown"] > 0.6 for label in labels])
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

    def to(self, device):
        """Copies crops and labels to the device, where batches are made."""
        self.crops = torch.cat([torch.from_numpy(np.ascontiguousarray(p)).permute(0, 3, 1, 2).contiguous().to(device) for p in self.pixels])
        self.labels = {name: torch.from_numpy(getattr(self, name)).long().to(device) for name in ("noun", "colour", "material", "tall")}
        self.colourful = torch.tensor([len(noun["colours"]) > 3 for noun in self.nouns], device=device)
        return self


def augment(images):
    """Augments: light, colour cast, sharpness, noise, shift, scale, mirroring."""
    n, device = len(images), images.device
    uniform = lambda *shape: 2 * torch.rand(*shape, device=device) - 1
    x = images.float() / 255
    white = (images.amin(1, keepdim=True) == 255).float()
    gain = 1 + 0.15 * uniform(n, 1, 1, 1) + 0.05 * uniform(n, 3, 1, 1)
    x = (x * gain + 0.06 * uniform(n, 1, 1, 1) + 0.02 * torch.randn_like(x)).clamp(0, 1)
    soft = torch.rand(n, device=device) < 0.35
    size = random.choice([24, 32, 44])
    blurred = F.interpolate(F.interpolate(x, size=size, mode="area"), size=EDGE, mode="bilinear")
    x = torch.where(soft[:, None, None, None], blurred, x)
    x = torch.lerp(x, torch.ones_like(x), white)
    # Mirrored, stretched, shifted and rotated a little; white beyond the border.
    flip = (torch.rand(n, device=device) < 0.5).float() * -2 + 1
    wide, high, turn = 1 + 0.1 * uniform(n), 1 + 0.1 * uniform(n), 0.08 * uniform(n)
    affine = torch.stack([torch.stack([flip * wide, -turn, 0.08 * uniform(n)], 1), torch.stack([turn, high, 0.08 * uniform(n)], 1)], 1)
    x = F.grid_sample(x - 1, F.affine_grid(affine, list(x.shape), align_corners=False), align_corners=False) + 1
    return (x - 0.5) / 0.5


def recolour(images, chosen):
    """Recolours the chosen crops (rotated hues, or shades of one colour), so that nouns are learnt from shape.
    Their colour and material are unknown afterwards."""
    n, device = len(images), images.device
    x = images.float() / 255
    white = (images.amin(1, keepdim=True) == 255)
    luma = (x * torch.tensor([0.299, 0.587, 0.114], device=device)[:, None, None]).sum(1, keepdim=True)
    # Rotated around the grey axis by a random angle (Rodrigues' formula).
    angle = 2 * math.pi * torch.rand(n, 1, 1, 1, device=device)
    turned = x * angle.cos() + torch.cat([x[:, 2:] - x[:, 1:2], x[:, :1] - x[:, 2:], x[:, 1:2] - x[:, :1]], 1) * (angle.sin() / math.sqrt(3))
    turned = turned + x.mean(1, keepdim=True) * (1 - angle.cos())
    # Shades keep each pixel's brightness relative to the mean.
    shown = (~white).float()
    mean = (luma * shown).sum((2, 3), keepdim=True) / shown.sum((2, 3), keepdim=True).clamp(min=1)
    shades = (luma / mean.clamp(min=0.05)) * (0.08 + 0.84 * torch.rand(n, 3, 1, 1, device=device))
    other = torch.where((torch.rand(n, device=device) < 0.5)[:, None, None, None], turned, shades).clamp(0, 1)
    other = torch.where(white, torch.ones((), device=device), other)
    return torch.where(chosen[:, None, None, None], other * 255, x * 255).to(torch.uint8)


class Batches(torch.utils.data.IterableDataset):
    """Batches of crop indices and texts about them, made by worker processes."""

    def __init__(self, data, words, tokenizer, args):
        self.words, self.tokenizer, self.args = words, tokenizer, args
        self.labels = data.noun, data.colour, data.material, data.tall
        # Rare nouns are drawn more often than they occur, though less often than frequent ones.
        self.chance = 1 / np.sqrt(np.bincount(data.noun, minlength=len(data.nouns))[data.noun])
        self.chance = np.cumsum(self.chance / self.chance.sum())

    def __iter__(self):
        worker = torch.utils.data.get_worker_info()
        seed = self.args.seed * 1000 + (worker.id if worker else 0)
        random.seed(seed); np.random.seed(seed)
        noun, colour, material, tall = self.labels
        words, args = self.words, self.args
        while True:
            index = np.minimum(np.searchsorted(self.chance, np.random.random(args.batch)), len(self.chance) - 1)
            texts, said = [], []
            for k in np.random.choice(index, args.texts):
                other = random.random() < 0.25
                text, true = words.sample(int(noun[k]), random.choice(COLOURS) if other else COLOURS[colour[k]],
                                          MATERIALS[material[k]], {1: True, 0: False, -1: None}[int(tall[k])])
                if random.random() < 0.08:
                    text, true = words.absent()
                texts.append(text); said.append(true)
            # For the softmax terms: one text for each noun, colour and material.
            noun_words = [random.choice(of) for of in words.words_of]
            texts += [random.choice(PROMPTS).format(word) for word in noun_words]
            texts += [random.choice(["{}", "something {}", "{} thing"]).format(c) for c in COLOURS]
            texts += [random.choice(["something {}", "{} thing", "{}"]).format(random.choice(MATERIAL_WORDS.get(m, [m]))) for m in MATERIALS]
            of = np.ones((args.texts, len(words.nouns)), bool)
            for row, (nouns, *_) in zip(of, said):
                if nouns is not None:
                    row[:] = False
                    row[list(nouns)] = True
            number = lambda all, value: -1 if value is None else all.index(value)
            asked = [[number(COLOURS, c), number(MATERIALS, m), -1 if high is None else int(high)] for _, c, m, high in said]
            also = [[n in words.of_word[w] for w in noun_words] for n in range(len(words.nouns))]
            yield (torch.from_numpy(index), *tokens_of(self.tokenizer, texts), torch.from_numpy(of), torch.tensor(asked), torch.tensor(also))


def tokens_of(tokenizer, texts):
    """Returns the padded ids and the length of each row."""
    ids = [encoding.ids for encoding in tokenizer.encode_batch(texts)]
    ids = [i if len(i) <= TOKENS else i[:TOKENS - 1] + [0] for i in ids]
    lengths = torch.tensor([len(i) for i in ids])
    padded = torch.zeros(len(ids), TOKENS, dtype=torch.long)
    for row, i in zip(padded, ids):
        row[:len(i)] = torch.tensor(i)
    return padded, lengths


def encode_texts(model, tokenizer, texts, device):
    ids, lengths = tokens_of(tokenizer, texts)
    return model(ids[:, :int(lengths.max())].to(device), lengths.to(device))


def truth_of(labels, of, asked):
    """Returns [crops, texts]: 1 true, 0 false, -1 unknown. `labels` are [crops], `of` [texts, nouns], `asked`
    [texts, 3]: colour, material and whether tall, -1 where nothing is said."""
    true = of[:, labels["noun"]].T
    known = torch.ones_like(true)
    for column, name in enumerate(("colour", "material", "tall")):
        said, of_crop = asked[:, column], labels[name][:, None]
        known &= ~((said != -1) & (of_crop == -1))
        true = true & ((said == -1) | (of_crop == said) | (of_crop == -1))
    # A text that is false for one reason is false, even if the rest is unknown.
    return torch.where(known | ~true, true.long(), -1)


def train(args, data, words, tokenizer):
    device = args.device
    torch.manual_seed(args.seed); random.seed(args.seed); np.random.seed(args.seed)
    image, text, log_scale, bias = load(args.resume) if args.resume else (ImageEncoder(), TextEncoder(), math.log(12.0), -7.0)
    image, text = image.train().to(device).to(memory_format=torch.channels_last), text.train().to(device)
    scale, bias = (nn.Parameter(torch.tensor(value, device=device)) for value in (log_scale, bias))
    # The kept weights are the mean over the last steps.
    kept = copy.deepcopy([image, text])
    groups = [{"params": [*image.parameters(), *text.parameters()], "weight_decay": 0.02}, {"params": [scale, bias], "weight_decay": 0.0}]
    optimiser = torch.optim.AdamW(groups, lr=args.rate, betas=(0.9, 0.98))
    data.to(device)
    batches = iter(torch.utils.data.DataLoader(Batches(data, words, tokenizer, args), batch_size=None, num_workers=args.workers))
    n_nouns = len(data.nouns)
    began = time.time()
    step, mean = 0, None
    while True:
        # Training lasts a given time, so the rate reaches 0 on any machine; the card states the number of steps.
        done = min(1.0, (time.time() - began) / args.seconds) if args.seconds else step / args.steps
        if done >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = args.rate * min(1, (step + 1) / 500) * (0.5 + 0.5 * math.cos(math.pi * done))
        index, ids, lengths, of, asked, also = (t.to(device, non_blocking=True) for t in next(batches))
        labels = {name: of_all[index] for name, of_all in data.labels.items()}
        # Only nouns seen in many colours: for others, the colour is evidence.
        recoloured = (torch.rand(len(index), device=device) < args.recoloured) & data.colourful[labels["noun"]]
        for name in ("colour", "material"):
            labels[name] = torch.where(recoloured, -1, labels[name])
        pixels = augment(recolour(data.crops[index], recoloured)).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device, dtype=torch.bfloat16):
            x, y = image(pixels), text(ids, lengths)
        cosines = x.float() @ y.float().T
        pairs = cosines[:, :args.texts] * scale.exp() + bias
        truth = truth_of(labels, of, asked)
        loss = F.binary_cross_entropy_with_logits(pairs, truth.float().clamp(min=0), reduction="none")
        loss = (loss * (truth >= 0)).sum() / args.batch * (256 / args.texts)
        nouns, colours, materials = (cosines[:, args.texts:] * 16).split([n_nouns, len(COLOURS), len(MATERIALS)], dim=1)
        noun = labels["noun"]
        others = also[noun] & (torch.arange(n_nouns, device=device) != noun[:, None])
        softmax = F.cross_entropy(nouns.masked_fill(others, -1e4), noun)
        softmax = softmax + 0.4 * F.cross_entropy(colours, labels["colour"], ignore_index=-1)
        softmax = softmax + 0.4 * F.cross_entropy(materials, labels["material"], ignore_index=-1)
        optimiser.zero_grad(set_to_none=True)
        (0.25 * loss + softmax).backward()
        torch.nn.utils.clip_grad_norm_([*image.parameters(), *text.parameters()], 1.0)
        optimiser.step()
        step += 1
        keep(kept, [image, text], 1 - 1 / min(2000, 10 + step // 10))
        if step % 50 == 0:
            now = np.array([loss.item(), softmax.item(), (nouns.argmax(1) == noun).float().mean().item()])
            mean = now if mean is None else 0.8 * mean + 0.2 * now
        if step % 500 == 0:
            print(f"{step} {time.time() - began:.0f} s  pairs {mean[0]:.3f}  softmax {mean[1]:.3f}  noun {mean[2]:.3f}", flush=True)
            save(args.out, kept, scale, bias)
    return kept[0].eval(), kept[1].eval(), float(scale.exp()), float(bias), step


def save(out, models, log_scale, bias):
    torch.save([models[0].state_dict(), models[1].state_dict(), log_scale, bias], out / "check.pt")


def load(folder):
    states = torch.load(folder / "check.pt", map_location="cpu")
    image, text = ImageEncoder(), TextEncoder()
    image.load_state_dict(states[0]); text.load_state_dict(states[1])
    return image, text, float(states[2]), float(states[3])


@torch.no_grad()
def keep(kept, now, share):
    """Moves the averaged parameters towards the current ones; batch statistics are copied."""
    for old, new in zip(kept, now):
        torch._foreach_lerp_(list(old.parameters()), list(new.parameters()), 1 - share)
        for a, b in zip(old.buffers(), new.buffers()):
            a.copy_(b)


@torch.no_grad()
def evaluate(image, text, tokenizer, data, words, scale, bias, device):
    data.to(device)
    x = torch.cat([image((block.float() / 255 - 0.5) / 0.5).cpu() for block in data.crops.split(512)])
    encode = lambda texts: encode_texts(text, tokenizer, texts, device).cpu()
    nouns = x @ encode([f"a {n['name']}" for n in data.nouns]).T
    colours = x @ encode([f"something {c}" for c in COLOURS]).T
    materials = x @ encode([f"something made of {m}" for m in MATERIALS]).T
    top1 = nouns.argmax(1).numpy() == data.noun
    # Among crops of one noun: which colour?
    pairs = encode([f"{c} {n['name']}" for n in data.nouns for c in COLOURS]).reshape(len(data.nouns), len(COLOURS), DIM)
    of_noun = torch.einsum("nd,ncd->nc", x, pairs[data.noun]).argmax(1).numpy() == data.colour
    found = lambda mask, right: float(right[mask].mean()) if mask.any() else None
    colour = colours.argmax(1).numpy() == data.colour
    material = materials.argmax(1).numpy() == data.material
    shells = np.isin(data.noun, [i for i, n in enumerate(data.nouns) if n["name"] in ("floor", "wall", "ceiling", "grass", "road", "pavement")])
    groups = {"all": np.ones(len(top1), bool), "whole": data.whole, "cut or hidden": ~data.whole & ~data.segmented,
              "segments": data.segmented, 
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
    # Present or absent: texts of present things against texts of absent ones.
    absent = x @ encode([f"a {word}" for word in ABSENT]).T
    own = nouns[torch.arange(len(x)), torch.from_numpy(data.noun)]
    threshold = -bias / scale
    report["found"] = {"own noun above the threshold": float((own > threshold).float().mean()),
                       "absent nouns above the threshold": float((absent > threshold).float().mean()),
                       "other nouns above the threshold": float(((nouns > threshold).float().sum() - (own > threshold).float().sum()) / (nouns.numel() - len(own)))}
    return report, confusion


def halve(path):
    """Stores a model's weights in 16 bits; the runtime widens them on loading."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    model = onnx.load(path)
    kept, casts = [], []
    for tensor in model.graph.initializer:
        if tensor.data_type != TensorProto.FLOAT or int(np.prod(tensor.dims)) < 64:
            kept.append(tensor)
            continue
        name = tensor.name + "_16"
        kept.append(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float16), name))
        casts.append(helper.make_node("Cast", [name], [tensor.name], to=TensorProto.FLOAT))
    del model.graph.initializer[:]
    model.graph.initializer.extend(kept)
    nodes = casts + list(model.graph.node)
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.save(model, path)


def export(out, image, text, tokenizer):
    out.mkdir(parents=True, exist_ok=True)
    image, text = image.cpu().to(memory_format=torch.contiguous_format), text.cpu()
    torch.onnx.export(image, (torch.zeros(2, 3, EDGE, EDGE),), out / "image.onnx", input_names=["pixel_values"], output_names=["image_embeds"],
                      dynamic_axes={"pixel_values": {0: "n"}, "image_embeds": {0: "n"}}, opset_version=17, dynamo=False)
    torch.onnx.export(text, (torch.zeros(2, 5, dtype=torch.long),), out / "text.onnx", input_names=["input_ids"], output_names=["text_embeds"],
                      dynamic_axes={"input_ids": {0: "n", 1: "tokens"}, "text_embeds": {0: "n"}}, opset_version=17, dynamo=False)
    for name in ("image.onnx", "text.onnx"):
        halve(out / name)
    tokenizer.save(str(out / "tokenizer.json"), pretty=False)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("test")
    parser.add_argument("train", nargs="*", help="none: only evaluates and exports what --resume names")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=30000)
    parser.add_argument("--seconds", type=float, default=0, help="stop after this time instead")
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--texts", type=int, default=512)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--workers", type=int, default=12, help="processes that write texts; other batches with another number")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--recoloured", type=float, default=0.35, help="part of the crops that get other colours")
    parser.add_argument("--resume", type=pathlib.Path, help="folder of an earlier run's tokenizer.json and check.pt, to go on from")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    tall_of = None
    tokenizer = Tokenizer.from_file(str(args.resume / "tokenizer.json")) if args.resume else None
    if args.train:
        data = Data(args.train)
        words, tall_of = Words(data.nouns), data.tall_of
        tokenizer = tokenizer or train_tokenizer(words, args.seed)
        tokenizer.save(str(args.out / "tokenizer.json"), pretty=False)
        print(f"{len(data.noun)} crops, {len(data.nouns)} nouns, {tokenizer.get_vocab_size()} tokens, on {args.device}", flush=True)
        image, text, scale, bias, steps = train(args, data, words, tokenizer)
        save(args.out, [image, text], torch.tensor(math.log(scale)), torch.tensor(bias))
    else:
        image, text, scale, bias = load(args.resume)
        image, text, scale, steps, args.device = image.eval(), text.eval(), math.exp(scale), 0, "cpu"
        words = Words(Data([args.test]).nouns)
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
