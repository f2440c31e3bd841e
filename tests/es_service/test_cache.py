"""Values that are kept until newer ones need their room."""

import numpy as np

from es_service.protocol.content import Cache


def arrays(kilobytes, value=0.0):
    return {"a": np.full(kilobytes * 128, value), "b": np.zeros(0, np.float32)}


def test_parts_not_asked_for_the_longest_are_forgotten_when_there_are_too_many_bytes():
    recent = Cache(lambda part: sum(values.nbytes for values in part.values()))

    def add(name, kilobytes, **limits):
        recent.add(name, arrays(kilobytes))
        recent.forget_oldest(3 * 1024, **limits)
        return list(recent)

    assert [add(name, 1) for name in "xyz"][-1] == ["x", "y", "z"]
    recent.use(["x", "not kept"])
    assert add("w", 1) == ["z", "x", "w"]
    assert add("large", 4) == []
    assert add("large", 4, spared=["large"]) == ["large"]
    assert add("small", 3) == ["small"]
    recent.forget("small")
    recent.forget("small")
    assert add("other", 2) == ["other"], "what is forgotten needs no room"
    assert add("other", 3) == ["other"], "nor what is replaced"
