"""Sealed campaigns are scored by anyone who has their labels."""

import json

from benchmarks.sealed_score import main


def test_answers_are_compared_with_published_labels(tmp_path, capsys):
    labels = {
        "a": {"effects": ["lag@y"], "same": {"lag@y": ["delay@y"]}},
        "b": {"effects": []},
        "c": {"effects": []},
        "d": {"effects": ["lag@y"]},
    }
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    for name, kind, effects in (("a", "effect", ["delay@y"]), ("b", "effect", ["gain@y"]), ("d", "complete", [])):
        verdict = {"kind": kind, "effects": effects, "one_of": [], "ports": ["y"]}
        (tmp_path / f"{name}.json").write_text(json.dumps({"verdict": verdict, "answers": []}))
    main([str(tmp_path / "labels.json"), str(tmp_path)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("a: right")
    assert lines[1].startswith("b: a complete model is not called complete: gain@y")
    assert lines[2].startswith("c: no answer;")
    assert lines[3].startswith("d: the gap is not seen")
    assert lines[4].startswith("right: 0.25")
