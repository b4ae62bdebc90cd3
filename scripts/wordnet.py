#!/usr/bin/env python3
"""Generates the word table of the grammar and the attribute names from WordNet's noun graph.

    apt-get install wordnet-base
    scripts/wordnet.py /usr/share/wordnet crates/uniground-models/src/attributes/wordnet.tsv

The first lines are kinds of things, parents before children: the number of the line of the broader kind (empty for a root), how often
WordNet's tagged texts speak of it (empty where they never do), then its words. The last line, after an empty one, has other English words:
a word there is not a misspelling. WordNet 3.0's license is next to the table.
"""

import sys
from pathlib import Path

# Lexicographer files whose senses are objects in rooms. Plants, animals and dishes have thousands of rare names: only those that occur in WordNet's
# tagged texts are used.
ARTIFACT, ANIMAL, FOOD, OBJECT, PLANT = 6, 5, 13, 17, 20
THINGS = {ARTIFACT, OBJECT}
OCCURRING = {ANIMAL, FOOD, PLANT}
# Kinds that are included anyway: they stand in a pot or a vase, or are held by something.
NAMED = {"vascular plant", "food"}
# WordNet has no words of these kinds.
SMALL_WORDS = """
about above across after again against all along also although always among an and any anybody anyone anything anywhere are around as at
away be because been before behind being below beneath beside besides between beyond both but by can cannot could did do does doing done
down during each either else ever every everybody everyone everything everywhere few for from had has have he her here hers herself him
himself his how however i if in inside into is it its itself just may maybe me might mine more most much must my myself near neither never
next no nobody none nor not nothing nowhere of off on once one only onto or other others ought our ours ourselves out outside over own past
per perhaps please shall she should since so some somebody someone something sometimes somewhere still such than that the their theirs them
themselves then there therefore these they this those though through throughout till to together too toward towards under underneath until
up upon us very via was we well were what whatever when whenever where wherever whether which while who whoever whole whom whose why will
with within without would yes yet you your yours yourself
""".split()


def senses(folder, part):
    """Reads the synsets of a part of speech by offset: lexicographer file, words, their numbers in that file, offsets of broader ones."""
    found = {}
    for line in (folder / f"data.{part}").read_text().splitlines():
        if line.startswith(" "):
            continue
        fields = line.split(" | ")[0].split()
        offset, file, count = fields[0], int(fields[1]), int(fields[3], 16)
        words = [w.split("(")[0].lower().replace("_", " ").replace("-", " ").replace("'", "") for w in fields[4 : 4 + 2 * count : 2]]
        numbers = [int(number, 16) for number in fields[5 : 5 + 2 * count : 2]]
        rest = fields[4 + 2 * count + 1 :]
        # Pointers: symbol, offset, part of speech, source and target.
        broader = [rest[i + 1] for i in range(0, len(rest) - 3, 4) if rest[i] == "@"]
        found[offset] = (file, words, numbers, broader)
    return found


def main():
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    nouns = senses(folder, "noun")
    tagged = {}
    for line in (folder / "cntlist.rev").read_text().splitlines():
        sense, _, count = line.split()
        lemma, rest = sense.split("%")
        kind, file, number, _ = rest.split(":", 3)
        if kind == "1":
            word = lemma.replace("_", " ").replace("-", " ").replace("'", "")
            tagged[(word, int(file), int(number))] = int(count)
    occurring = {(word, file) for word, file, _ in tagged}
    # The senses of a word in order of use, objects only; the two most used are stored.
    kept, of_word = set(), {}
    for line in (folder / "index.noun").read_text().splitlines():
        if line.startswith(" "):
            continue
        fields = line.split()
        word = fields[0].replace("_", " ").replace("-", " ").replace("'", "")
        offsets = fields[-int(fields[2]) :]
        for offset in offsets:
            file = nouns[offset][0]
            occurs = file in OCCURRING and (word, file) in occurring
            if (file in THINGS or occurs or word in NAMED) and len(of_word.setdefault(word, [])) < 2 and len(word.split()) < 4:
                of_word[word].append(offset)
                kept.add(offset)
    for offset in list(kept):
        while nouns[offset][3]:
            offset = nouns[offset][3][0]
            kept.add(offset)
    order, number = [], {}

    def place(offset):
        if offset in number:
            return
        file, spoken, numbers, broader = nouns[offset]
        broader = broader[:1]
        for parent in broader:
            place(parent)
        number[offset] = len(order)
        parent = str(number[broader[0]]) if broader else ""
        words = []
        for word in spoken:
            if offset in of_word.get(word, []):
                # The most used sense of a word is marked.
                words.append(word if of_word[word][0] == offset else "~" + word)
        times = sum(tagged.get((word, file, number), 0) for word, number in zip(spoken, numbers))
        order.append(f"{parent}\t{times or ''}\t" + ",".join(dict.fromkeys(words)))

    for offset in sorted(kept):
        place(offset)
    english = set(SMALL_WORDS)
    for part in ["noun", "verb", "adj", "adv"]:
        for line in (folder / f"data.{part}").read_text().splitlines():
            fields = line.split()
            for word in fields[4 : 4 + 2 * int(fields[3], 16) : 2] if not line.startswith(" ") else []:
                # Names of people and places are not misspelled words.
                if word.isalpha() and word.isascii() and word.islower() and 3 < len(word) < 15:
                    english.add(word)
        for line in (folder / f"{part}.exc").read_text().splitlines():
            english.update(w for w in line.split() if w.isalpha() and 3 < len(w) < 15)
    out.write_text("\n".join(order) + "\n\n" + " ".join(sorted(english)) + "\n")
    print(f"{len(order)} kinds, {len(of_word)} words for them, {len(english)} other words, {out.stat().st_size} bytes")


main()
