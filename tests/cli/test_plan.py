"""What a scene needs and why: `stages`, `judge` and the command."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from chromeball.cli.freshness import judge
from chromeball.cli.main import build_app
from chromeball.cli.stages import StagePlan, lens_text, stages
from chromeball.scene.errors import UserError
from chromeball.scene.manifest import Lens, parse_scene
from tests.cli.scenes import FULL, photograph


def planned(text: str, root: Path) -> dict[str, StagePlan]:
    path = root / "scene.toml"
    return {stage.name: stage for stage in stages(parse_scene(text, path), path)}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    photograph(tmp_path)
    return tmp_path


def changed(old: str, new: str, text: str = FULL) -> str:
    assert old in text, old
    return text.replace(old, new)


def test_full_scene_needs_all_but_the_pose_of_a_view_without_photograph(root: Path) -> None:
    plan = planned(FULL, root)
    skipped = {name: stage.reason for name, stage in plan.items() if not stage.needed}
    assert skipped == {
        "calibrate pose wide": "no photograph behind the view",
        "envmap sun": "no [env.sun]: the map is as it was seen",
        "envmap harmonics": "nobody asks: env.realtime is false",
        "envmap prefilter": "nobody asks: env.realtime is false",
    }


def test_commands_are_the_explicit_forms(root: Path) -> None:
    plan = planned(FULL, root)
    command = {name: " ".join(stage.command) for name, stage in plan.items()}
    assert command["take front"] == (
        "chromeball acquire bracket --device visca:/dev/ttyUSB0 --video v4l2:/dev/video0 "
        "--times 1/4,0.001 -o takes/front"
    )
    assert command["take plate"] == (
        "chromeball acquire import photos/p1.jpg photos/p2.jpg --times 0.1,0.2 -o takes/plate"
    )
    assert command["hdr response"] == (
        "chromeball hdr response takes/front -o build/response.json"
    )
    assert command["hdr merge back"] == (
        "chromeball hdr merge takes/back --response build/response.json -o build/back.exr"
    )
    assert command["calibrate lens"] == (
        "chromeball calibrate lens photos/board_1.jpg photos/board_2.jpg "
        "--target chessboard:9x6:0.025 --model auto -o build/lens.cameramodel"
    )
    assert command["envmap probe"] == (
        "chromeball envmap probe build/front.exr build/back.exr --yaw 0,-180 "
        "--lens equisolid:190 --align build/align.json --width 1024 -o build/env.exr"
    )
    assert command["calibrate pose main"] == (
        "chromeball calibrate pose --camera build/lens.cameramodel "
        "--points 1,2 3,4 5.5,6 7,8 --align build/align.json -o build/main.cameramodel"
    )
    assert command["render main"] == (
        "chromeball render scene.toml --view main -o build/main.exr"
    )
    assert plan["render main"].outputs == ("build/main.exr", "build/main.png")


def test_a_finished_panorama_is_turned_and_not_stitched(root: Path) -> None:
    text = changed("[probe]", '[env]\nfile = "sky.hdr"\n[probe]')
    text = text.replace('picture = "front"', 'picture = "env"')
    plan = planned(text, root)
    assert plan["envmap align"].inputs == ("sky.hdr",)
    assert plan["envmap probe"].inputs == ("sky.hdr", "build/align.json")
    assert plan["envmap probe"].command[-2:] == ("-o", "build/env.exr")
    assert "finished panorama" in plan["envmap probe"].reason
    assert "build/env.exr" in plan["render main"].inputs
    with pytest.raises(UserError, match="not for a finished panorama"):
        planned(text.replace("[env]\n", "[env]\nground = [0.2, 0.2, 0.2]\n"), root)
    # other maps that are left out again are light that changed, not only a file less
    texts = [
        planned(text.replace("[env]\n", f"[env]\n{others}"), root)["render main"].slice_text()
        for others in ('others = ["a.exr", "b.exr"]\n', 'others = ["b.exr", "a.exr"]\n', "")
    ]
    assert len({*texts}) == 3


def test_a_restored_sun_stands_between_the_shots_and_everything_else(root: Path) -> None:
    sun = '[env]\nsun = { ratio = [6, 5.5, 5], normal = "sun", radius = 0.3 }\n[probe]'
    plan = planned(changed("[probe]", sun), root)
    assert plan["envmap probe"].outputs == ("build/env_seen.exr",)
    assert " ".join(plan["envmap sun"].command) == (
        "chromeball envmap sun build/env_seen.exr --ratio 6,5.5,5 --normal sun --radius 0.3 "
        "--accuracy 0.05 -o build/env.exr"
    )
    assert plan["render main"].inputs[0] == "build/env.exr"
    both = changed("[probe]", "[env]\nsun = { ratio = 6, meter = 80000 }\n[probe]")
    with pytest.raises(UserError, match="one of the two"):
        planned(both, root)


def test_no_prefiltering_without_glossy_objects(root: Path) -> None:
    asked = changed("[probe]", "[env]\nrealtime = true\n[probe]")
    plan = planned(asked, root)
    assert plan["envmap harmonics"].outputs == ("build/harmonics.json", "build/irradiance.exr")
    assert plan["envmap prefilter"].reason == "no object is glossy"
    metal = asked.replace('kind = "diffuse"', 'kind = "mirror"')
    plan = planned(metal, root)
    assert plan["envmap prefilter"].needed
    assert plan["envmap prefilter"].reason == "reflections of ball in real-time engines"
    assert plan["envmap prefilter"].outputs[0] == "build/env.ktx2"


def test_a_probe_of_balls_and_masks_in_full(root: Path) -> None:
    text = changed(
        'lens = { model = "equisolid", fov = 190 }\n', "trim = 1.5\nrefine = false\n"
    )
    text = changed(
        '{ bracket = "front" }, { bracket = "back", yaw = -180 }',
        '{ bracket = "front", ball = [300, 200, 90], mask = "m1.png" }, '
        '{ bracket = "back", yaw = -90, ball = [310, 210, 91.5], mask = "m2.png" }',
        text,
    )
    text = changed("[probe]", '[env]\nground = [0.2, 0.2, 0.1]\nfill = "main"\n[probe]', text)
    plan = planned(text, root)["envmap probe"]
    assert " ".join(plan.command) == (
        "chromeball envmap probe build/front.exr build/back.exr --yaw 0,-90 "
        "--ball 300,200,90 310,210,91.5 --photographer 20 --reflectance 1,1,1 --trim 1.5 "
        "--mask m1.png m2.png --no-refine --ground 0.2,0.2,0.1 "
        "--fill build/plate.exr:build/main.cameramodel --align build/align.json "
        "--width 1024 -o build/env.exr"
    )
    assert {"m1.png", "m2.png", "build/plate.exr", "build/main.cameramodel"} <= set(plan.inputs)
    for old, new, message in (
        (", ball = [310, 210, 91.5]", "", "either all shots are of a ball"),
        (', mask = "m2.png"', "", "either all shots have a mask"),
        ("trim = 1.5", "refine_lens = true", "refine_lens solves"),
        ("trim = 1.5", 'lens = { model = "equisolid", fov = 190 }', "but no lens"),
        ('fill = "main"', 'fill = "mian"', "main"),
        ('fill = "main"', 'fill = "wide"', "no photograph"),
    ):
        with pytest.raises(UserError, match=message):
            planned(changed(old, new, text), root)


def test_refined_times_reach_the_solver(root: Path) -> None:
    text = changed("spp = 64", "spp = 64\n[hdr]\nrefine_times = true")
    assert "--refine-times" in planned(text, root)["hdr response"].command
    text = changed("spp = 64", "spp = 64\n[hdr]\nrefine_times = false")
    assert "--no-refine-times" in planned(text, root)["hdr response"].command


def test_a_hand_held_bracket_is_aligned_first(root: Path) -> None:
    text = changed('name = "front"', 'name = "front"\nhandheld = true\nmoving = true\nnd = [3]')
    plan = planned(text, root)
    motion = "build/front.motion.json"
    assert plan["hdr align front"].outputs == (motion,)
    assert motion in plan["hdr response"].inputs
    assert motion in plan["hdr merge front"].inputs
    command = plan["hdr merge front"].command
    assert command[command.index("--motion") + 1] == motion
    assert "--deghost" in command
    assert command[command.index("--nd") + 1] == "3"
    assert "hdr align back" not in plan


def test_a_light_meter_gives_one_scale_to_all_brackets(root: Path) -> None:
    meter = '[hdr.meter]\nbracket = "plate"\nat = [10, 20]\n'
    plan = planned(changed("[render]", meter + "luminance = 250\n[render]"), root)
    command = plan["hdr merge plate"].command
    assert command[command.index("--luminance") :][:4] == (
        "--luminance",
        "250",
        "--at",
        "10,20",
    )
    assert "build/plate.exr" in plan["hdr merge front"].inputs
    assert "--scale-from" in plan["hdr merge front"].command
    names = list(plan)
    assert names.index("hdr merge plate") < names.index("hdr merge front")
    card = "reflectance = 0.18\nilluminance = 1000\n[render]"
    plan = planned(changed("[render]", meter + card), root)
    assert "--grey-card" in plan["hdr merge plate"].command
    for wrong in ("[render]", "reflectance = 0.2\n[render]", "luminance = 2\n" + card):
        with pytest.raises(UserError, match="meter needs"):
            planned(changed("[render]", meter + wrong), root)


def test_brackets_of_one_curve_have_one_filter_and_one_stand(root: Path) -> None:
    both = '\n[hdr]\nsolve_from = ["front", "back"]\n'
    for line, message in (("nd = [3]", "ND filters"), ("handheld = true", "by hand")):
        text = changed('name = "front"', f'name = "front"\n{line}')
        text = text.replace("spp = 64", "spp = 64" + both)
        with pytest.raises(UserError, match=message):
            planned(text, root)


def test_values_that_begin_with_a_minus_sign_are_tied_to_their_option(root: Path) -> None:
    text = changed('{ bracket = "front" }', '{ bracket = "front", yaw = -90 }')
    assert "--yaw=-90,-180" in planned(text, root)["envmap probe"].command


@pytest.mark.parametrize(
    ("old", "new", "stage", "reason"),
    [
        (
            "spp = 64",
            'spp = 64\n[hdr]\nresponse = "old.json"',
            "hdr response",
            "old.json is given",
        ),
        (
            "[probe]",
            '[env]\nfile = "sky.hdr"\n[probe]',
            "take front",
            "no shot and no view uses it",
        ),
        (
            'target = "chess',
            'camera = "a.cameramodel"\ntarget = "chess',
            "calibrate lens",
            "a.cameramodel is a finished camera",
        ),
        (
            'bracket = "plate"\npoints',
            'bracket = "plate"\ncamera = "b.cameramodel"\npoints',
            "calibrate lens",
            "every view names its own camera",
        ),
        (
            'bracket = "plate"\npoints = [[1, 2], [3, 4], [5.5, 6], [7, 8]]',
            "",
            "calibrate pose main",
            "no photograph behind the view",
        ),
        (
            'bracket = "plate"\npoints = [[1, 2], [3, 4], [5.5, 6], [7, 8]]',
            "",
            "calibrate lens",
            "no view has a photograph behind it",
        ),
        (
            'bracket = "plate"\npoints = [[1, 2], [3, 4], [5.5, 6], [7, 8]]',
            'bracket = "plate"\ncamera = "c.cameramodel"',
            "calibrate pose main",
            "c.cameramodel holds the pose",
        ),
        (
            '[[stand_in]]\nname = "floor"\nkind = "plane"\nsize = [2, 2]',
            "",
            "stand-in depth",
            "no [[stand_in]]",
        ),
        (
            '[[stand_in]]\nname = "floor"\nkind = "plane"\nsize = [2, 2]',
            "",
            "stand-in build",
            "no [[stand_in]]",
        ),
        (
            'device = "visca:/dev/ttyUSB0"\nvideo = "v4l2:/dev/video0"\n'
            'times = ["1/4", 0.001]\n[[bracket]]\nname = "back"',
            'take = "takes/old"\n[[bracket]]\nname = "back"',
            "take front",
            "takes/old is a finished take",
        ),
    ],
)
def test_what_is_not_needed_is_skipped_with_its_reason(
    root: Path, old: str, new: str, stage: str, reason: str
) -> None:
    text = changed(old, new)
    if "sky.hdr" in new:
        text = changed('picture = "front"', 'picture = "env"', text)
    skipped = planned(text, root)[stage]
    assert not skipped.needed
    assert skipped.reason == reason
    assert skipped.outputs == skipped.command == skipped.inputs == ()


def test_a_sequence_has_a_stage_for_each_frame_that_depends_on_its_own_pose(
    root: Path,
) -> None:
    keys = "key = [{ frame = 1, position = [0, 0, 0] }, { frame = 3, position = [0, 0, 1] }]"
    text = changed('mesh = "sphere"', f'mesh = "sphere"\n{keys}')
    with pytest.raises(UserError, match="view 'main' is a sequence: say which"):
        planned(text, root)
    text = changed('name = "main"', 'name = "main"\nframes = "1-3"', text)
    text = changed('model = "equisolid"\n', 'model = "equisolid"\nframes = "2"\n', text)
    plan = planned(text, root)
    frames = {name for name in plan if name.startswith("render ")}
    assert frames == {"render main 0001", "render main 0002", "render main 0003"} | {
        "render wide 0002"
    }
    stage = plan["render main 0002"]
    assert stage.outputs == ("build/main.0002.exr", "build/main.0002.png")
    assert " ".join(stage.command) == (
        "chromeball render scene.toml --view main -o build/main.%04d.exr --frames 2 --force"
    )
    assert {"build/plate.exr", "build/main.cameramodel"} < set(stage.inputs)
    assert set(stage.outputs) < set(plan["report"].inputs)
    # the last key moves the frames between the last two, and no other
    more = changed("1] }]", "1] }, { frame = 4, position = [0, 0, 9] }]", text)
    again = planned(more, root)
    assert all(again[name].slice_text() == plan[name].slice_text() for name in frames)
    moved = planned(changed("[0, 0, 1]", "[0, 0, 2]", text), root)
    differ = {name for name in frames if moved[name].slice_text() != plan[name].slice_text()}
    assert differ == frames - {"render main 0001"}


def test_no_object_means_nothing_to_render_and_no_camera(root: Path) -> None:
    start, end = FULL.index("[[object]]"), FULL.index("[[view]]")
    plan = planned(FULL[:start] + FULL[end:], root)
    for name in ("render main", "render wide", "calibrate pose main", "calibrate lens"):
        assert not plan[name].needed
    assert plan["render main"].reason == "no [[object]]"
    assert plan["envmap lights"].needed


LINEAR = """
name = "linear"
[[bracket]]
name = "probe"
frames = ["a.{suffix}", "b.{suffix}"]
[probe]
lens = {{ model = "equidistant", fov = 180, centre = [10, 20], radius = 9.5 }}
shot = [{{ bracket = "probe" }}]
"""


@pytest.mark.parametrize("suffix", ["exr", "CR2", "dng", "hdr"])
def test_linear_frames_need_no_response_curve(tmp_path: Path, suffix: str) -> None:
    plan = planned(LINEAR.format(suffix=suffix), tmp_path)
    assert not plan["hdr response"].needed
    assert plan["hdr response"].reason == "all frames are linear"
    assert "--response" not in plan["hdr merge probe"].command
    assert plan["envmap align"].reason == "no [align]: the first shot's axes are the world's"
    assert "--align" not in plan["envmap probe"].command
    assert "equidistant:180:10,20,9.5" in plan["envmap probe"].command


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_coded_frames_need_one(tmp_path: Path, suffix: str) -> None:
    plan = planned(LINEAR.format(suffix=suffix), tmp_path)
    assert plan["hdr response"].needed
    assert "build/response.json" in plan["hdr merge probe"].inputs


def test_a_finished_take_tells_whether_its_frames_are_linear(tmp_path: Path) -> None:
    text = LINEAR.replace('frames = ["a.{suffix}", "b.{suffix}"]', 'take = "t"')
    text = text.format()
    (tmp_path / "t").mkdir()
    for suffix, needed in (("exr", False), ("png", True)):
        take = {"version": 1, "size": [4, 4], "frames": [{"file": f"a.{suffix}"}]}
        (tmp_path / "t/take.json").write_text(json.dumps(take))
        assert planned(text, tmp_path)["hdr response"].needed == needed
    (tmp_path / "t/take.json").write_text("{")
    with pytest.raises(UserError, match=r"take\.json: not a readable take"):
        planned(text, tmp_path)


def test_the_response_is_solved_from_what_is_named(root: Path) -> None:
    text = changed(
        "spp = 64",
        'spp = 64\n[hdr]\nsolve_from = ["back", "plate"]\nmethod = "debevec"\nsmoothness = 2',
    )
    assert planned(text, root)["hdr response"].command[3:9] == (
        "takes/back",
        "takes/plate",
        "--method",
        "debevec",
        "--smoothness",
        "2",
    )


def test_a_bracket_for_the_response_alone_is_taken_but_not_merged(root: Path) -> None:
    text = changed(
        "[render]",
        '[hdr]\nsolve_from = ["grey"]\n[[bracket]]\nname = "grey"\n'
        'frames = ["photos/g.jpg", "photos/h.jpg"]\n[render]',
    )
    plan = planned(text, root)
    assert plan["take grey"].needed
    assert not plan["hdr merge grey"].needed
    assert plan["hdr merge grey"].reason == "only the response curve is solved from it"


def test_an_emulated_camera_stands_before_the_bracket(root: Path) -> None:
    text = changed(
        'device = "visca:/dev/ttyUSB0"\nvideo = "v4l2:/dev/video0"\ntimes = ["1/4", 0.001]\n'
        "[probe]",
        'emulate = { radiance = "set/back.exr", seed = 7 }\ntimes = ["1/4"]\n[probe]',
    )
    stage = planned(text, root)["take back"]
    assert " ".join(stage.command) == (
        "chromeball emulate visca --radiance set/back.exr --link build/dev/back "
        "--video socket:build/dev/back.sock --seed 7 -- "
        "chromeball acquire bracket --device visca:build/dev/back "
        "--video socket:build/dev/back.sock --times 1/4 -o takes/back"
    )
    assert stage.inputs == ("set/back.exr",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "main"', 'name = "plate"', "would both write build/plate.exr; rename one"),
        ('name = "main"', 'name = "env"', "would both write build/env.exr; rename one"),
        ("board_*", "nothing_*", r"no picture matches 'photos/nothing_\*.jpg'"),
        ("times = [0.1, 0.2]", "times = [0.1]", "'plate' has 2 frames but 1 times"),
        ('"photos/p2.jpg"', '"photos/p1.jpg"', "names 'photos/p1.jpg' twice"),
        (', "photos/p2.jpg"', "", "'plate' has one picture"),
        ('"photos/p2.jpg"', '"photos/p2.exr"', "mixes linear frames with others"),
        ('picture = "front"', 'picture = "plate"', "known: front, back"),
        ('folder = "build"', 'folder = "../x"', "within the scene's own folder"),
        ('folder = "build"', 'folder = "a b"', "use letters, digits"),
        ('folder = "build"', 'folder = "/x"', "within the scene's own folder"),
        ('[calibrate]\nimages = ["photos/board_*.jpg"]\ntarget = "chessboard:9x6:0.025"', "",
         "'main' has a photograph but no camera"),
        ('target = "chessboard:9x6:0.025"', "", "needs images and a target"),
        ('model = "equisolid"\n[render]', 'points = [[1,2],[3,4],[5,6],[7,8]]\n[render]',
         "'wide' has points but no photograph"),
        ('video = "v4l2:/dev/video0"\n', "", "'front' has a device but no video"),
        ('frames = ["photos/p1.jpg", "photos/p2.jpg"]\n', "", "needs frames, a take or"),
        ("lens = { model", 'camera = "x"\nlens = { model', "a lens or a camera, one of"),
    ],
)  # fmt: skip
def test_what_a_scene_lacks_is_one_clear_error(
    root: Path, old: str, new: str, message: str
) -> None:
    text = changed('name = "full"', 'name = "full"\nfolder = "build"')
    with pytest.raises(UserError, match=message) as caught:
        planned(changed(old, new, text), root)
    assert "scene.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_slices_hold_what_matters_and_no_more(root: Path) -> None:
    before = planned(FULL, root)

    def reran(old: str, new: str) -> set[str]:
        after = planned(changed(old, new), root)
        assert after.keys() == before.keys()
        return {n for n in before if after[n].slice_text() != before[n].slice_text()}

    assert reran("[0.1, 0.2, 0.3]", "[0.1, 0.2, 0.4]") == {"render main", "render wide"}
    assert reran("size = [2, 2]", "size = [2, 3]") == {"stand-in build"}
    assert reran("width = 0.45", "width = 0.46") == {"envmap align"}
    assert reran("yaw = -180", "yaw = 170") == {"envmap probe"}
    assert reran('target = "chessboard:9x6:0.025"', 'target = "chessboard:9x6:0.03"') == {
        "calibrate lens"
    }
    assert reran("fov = 190", "fov = 180") == {"envmap align", "envmap probe"}
    assert reran('name = "full"', '# remark\nname  =  "full"') == set()


def test_lens_text() -> None:
    assert lens_text(Lens(model="equisolid", fov=190)) == "equisolid:190"
    assert lens_text(Lens(model="equisolid", fov=190, radius=307.2)) == "equisolid:190:,,307.2"
    lens = Lens(model="equidistant", fov=180.5, centre=(1, 2), radius=3)
    assert lens_text(lens) == "equidistant:180.5:1,2,3"


# ---- up to date


def states(root: Path, text: str = FULL) -> dict[str, tuple[str, str]]:
    path = root / "scene.toml"
    plan = stages(parse_scene(text, path), path)
    return {v.stage.name: (v.state, v.cause) for v in judge(plan, root, "build")}


def make_all(root: Path, text: str = FULL) -> None:
    for stage in planned(text, root).values():
        if stage.needed:
            kept = root / stage.slice_file("build")
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(stage.slice_text())
            time.sleep(0.002)
            for output in stage.outputs:
                (root / output).parent.mkdir(parents=True, exist_ok=True)
                (root / output).write_text("made")


def test_states_follow_make(root: Path) -> None:
    first = states(root)
    assert first["take front"] == ("needed", "takes/front/take.json is not there yet")
    assert first["calibrate pose wide"] == ("skipped", "no photograph behind the view")
    make_all(root)
    done = states(root)
    assert {state for state, _ in done.values()} == {"up to date", "skipped"}
    assert done["render main"] == ("up to date", "nothing changed")

    (root / "takes/plate/take.json").touch()
    after = states(root)
    assert after["hdr merge plate"] == ("needed", "takes/plate/take.json is newer")
    assert after["render main"] == ("needed", "hdr merge plate runs before it")
    assert after["render wide"][0] == "up to date"
    assert after["envmap probe"][0] == "up to date"


def test_a_changed_key_is_named(root: Path) -> None:
    make_all(root)
    edited = states(root, changed("spp = 64", "spp = 65"))
    assert edited["render main"] == ("needed", "render.spp changed")
    edited = states(root, changed("[0.1, 0.2, 0.3]", "[0.1, 0.2, 0.4]"))
    assert edited["render wide"] == ("needed", "object[ball].material.color changed")
    assert edited["report"] == ("needed", "render main runs before it")
    edited = states(root, changed('model = "opencv8"', 'model = "opencv4"', FULL.replace(
        'target = "chess', 'model = "opencv8"\ntarget = "chess'
    )))  # fmt: skip
    assert edited["calibrate lens"] == ("needed", "its command changed")


def test_a_lost_input_is_named(root: Path) -> None:
    make_all(root)
    (root / "photos/p1.jpg").unlink()
    assert states(root)["take plate"] == (
        "needed",
        "photos/p1.jpg is gone and no stage makes it",
    )


# ---- the command


def run(*arguments: str) -> None:
    build_app()(list(arguments), result_action="return_value")


def test_command_prints_states_and_reasons(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "scene.toml").write_text(FULL)
    run("plan", str(root / "scene.toml"))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 21
    assert lines[0].startswith("take front           needed      2 exposures of visca:")
    assert any(line.startswith("calibrate pose wide  skipped") for line in lines)
    assert not list(root.glob("*.mk"))
    assert not (root / "build").exists()


def test_command_as_json(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "scene.toml").write_text(FULL)
    run("plan", str(root / "scene.toml"), "--json")
    rows = json.loads(capsys.readouterr().out)
    assert rows[0]["name"] == "take front"
    assert rows[0]["command"][:3] == ["chromeball", "acquire", "bracket"]
    assert {row["state"] for row in rows} == {"needed", "skipped"}


def test_makefile_rewrites_slices_only_when_they_change(root: Path) -> None:
    scene = root / "scene.toml"
    scene.write_text(FULL)
    run("plan", str(scene), "--makefile")
    slices = {p.name: p.stat().st_mtime_ns for p in (root / "build/slices").iterdir()}
    assert len(slices) == 17
    assert (root / "pipeline.mk").read_text().startswith("# Written by `chromeball plan")
    time.sleep(0.01)
    scene.write_text(changed("spp = 64", "spp = 32"))
    run("plan", str(scene), "--makefile")
    after = {p.name: p.stat().st_mtime_ns for p in (root / "build/slices").iterdir()}
    rewritten = {name for name in after if after[name] != slices[name]}
    # the report's slice holds the reasons it shows, sample counts among them
    assert rewritten == {"render-main.json", "render-wide.json", "report.json"}


def test_a_broken_scene_leaves_nothing_behind(root: Path) -> None:
    scene = root / "scene.toml"
    scene.write_text(changed('name = "main"', 'name = "plate"'))
    with pytest.raises(UserError):
        run("plan", str(scene), "--makefile")
    assert sorted(os.listdir(root)) == ["photos", "scene.toml"]
