"""What the tests' processes do faster comes out the same."""

import faster
from datasets import Features, Image, List, Sequence, Value

COLUMNS = {
    "index": Value("int64"),
    "nested": {"picture": Image(), "numbers": [Value("float32")]},
    "plain": {"of": {"strings": List(Value("string"))}},
    "pictures": [Image()],
    "undecoded": List(Image(decode=False)),
    "fixed": Sequence(Value("float32"), length=7),
    "front": Image(),
}


def filled(set_item, monkeypatch):
    with monkeypatch.context() as context:
        context.setattr(Features, "__setitem__", set_item)
        features = Features(COLUMNS)
        features["index"] = Image()
        features["late"] = List(Image())
        del features["front"]
        features["nested"] = Value("bool")
        features["front"] = Value("string")
    return features


def test_features_set_one_by_one_are_those_of_the_library(monkeypatch):
    assert Features.__setitem__ is faster.set_one
    ours, theirs = filled(faster.set_one, monkeypatch), filled(faster.SET_ALL, monkeypatch)
    assert list(ours.items()) == list(theirs.items())
    decoded = ours._column_requires_decoding
    assert list(decoded.items()) == list(theirs._column_requires_decoding.items())
    assert [name for name, asked in decoded.items() if asked] == ["index", "pictures", "late"]
    untouched = Features(COLUMNS)
    assert [name for name, asked in untouched._column_requires_decoding.items() if asked] == [
        "nested", "pictures", "front",
    ]  # fmt: skip
    assert isinstance(untouched["pictures"], List)
