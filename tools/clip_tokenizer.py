"""Converts CLIP's byte-pair tokenizer to a tokenizer.json, equal to open_clip's own except for ftfy's repair of broken encodings."""

import gzip
import string

from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, processors

START, END = "<start_of_text>", "<end_of_text>"
# What ftfy and html.unescape do to ordinary text.
REPAIRS = [
    ("[‘’‛ʼ]", "'"), ("[“”‟„]", '"'), ("ﬁ", "fi"), ("ﬂ", "fl"), ("ﬀ", "ff"), ("&lt;", "<"), ("&gt;", ">"),
    ("&quot;", '"'), ("&#39;", "'"), ("&nbsp;", " "), ("&amp;", "&"),
]  # fmt: skip


def bytes_to_unicode():
    """Maps each byte to a printable character, as in the vocabulary file."""
    kept = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    moved = [b for b in range(256) if b not in kept]
    return {**{b: chr(b) for b in kept}, **{b: chr(256 + i) for i, b in enumerate(moved)}}


def build(vocabulary, context_length, pad_id=0, clean="lower"):
    """vocabulary: open_clip's bpe_simple_vocab_16e6.txt.gz; clean: what the model's own tokenizer does first, lower or canonicalize."""
    lines = gzip.open(vocabulary).read().decode("utf-8").split("\n")[1 : 49152 - 256 - 2 + 1]
    merges = [tuple(line.split()) for line in lines]
    letters = list(bytes_to_unicode().values())
    tokens = letters + [letter + "</w>" for letter in letters] + ["".join(merge) for merge in merges] + [START, END]
    ids = {token: i for i, token in enumerate(tokens)}
    tokenizer = Tokenizer(models.BPE(vocab=ids, merges=merges, end_of_word_suffix="</w>", unk_token=END, fuse_unk=False))
    steps = [normalizers.NFC()] + [normalizers.Replace(Regex(pattern), text) for pattern, text in REPAIRS]
    if clean == "canonicalize":
        punctuation = "[" + "".join("\\" + c for c in string.punctuation) + "]"
        steps += [normalizers.Replace("_", " "), normalizers.Replace(Regex(punctuation), "")]
    steps += [normalizers.Replace(Regex(r"\s+"), " "), normalizers.Strip(), normalizers.Lowercase()]
    tokenizer.normalizer = normalizers.Sequence(steps)
    words = Regex(r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+")
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.Split(words, behavior="removed", invert=True), pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)]
    )
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{START} $A {END}", pair=f"{START} $A {END} $B {END}", special_tokens=[(START, ids[START]), (END, ids[END])]
    )
    tokenizer.decoder = decoders.Sequence([decoders.ByteLevel()])
    tokenizer.add_special_tokens([AddedToken(token, normalized=False, special=True) for token in (START, END)])
    tokenizer.enable_truncation(max_length=context_length)
    tokenizer.enable_padding(length=context_length, pad_id=pad_id, pad_token=tokens[pad_id])
    return tokenizer


if __name__ == "__main__":
    import sys

    if len(sys.argv) != 4:
        sys.exit("clip_tokenizer.py bpe_simple_vocab_16e6.txt.gz CONTEXT_LENGTH tokenizer.json")
    build(sys.argv[1], int(sys.argv[2])).save(sys.argv[3])
