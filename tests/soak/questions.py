"""Generates any number of different questions about objects in a living room."""
import itertools
import random

COLORS = ["", "red ", "blue ", "brown ", "white ", "black ", "green ", "orange ", "grey ", "small ", "large ", "wooden "]
NOUNS = ["chair", "stool", "mug", "table", "sofa", "plant", "curtain", "rug", "backpack", "trash can", "desk", "lamp", "door", "window",
         "coffee table", "dining table", "book", "picture"]
RELATIONS = ["next to", "closest to", "farthest from", "on", "under", "left of", "right of", "behind", "in front of", "above"]
ANCHORS = ["the dining table", "the coffee table", "the desk", "the door", "the window", "the red sofa", "the rug", "the trash can"]


def questions(number, seed):
    """Returns this many different questions, always the same for a seed."""
    every = [f"the {color}{noun} {relation} {anchor}"
             for color, noun, relation, anchor in itertools.product(COLORS, NOUNS, RELATIONS, ANCHORS) if noun not in anchor]
    return random.Random(seed).sample(every, number)
