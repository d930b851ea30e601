"""Visuals that cannot be drawn: one warning names each, its link is a capsule, and the rest of the arm is drawn."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from nbs_pin.base.exceptions import RobotError
from nbs_pin.reports.replay import replay
from nbs_pin.robots.meshes import MAX_GROUPS, MeshError, read_mesh
from nbs_pin.robots.visuals import STEEL, link_visuals, read_couplings
from tests.test_replay import bare_robot, moving_run

BOX = '<geometry><box size="1 1 1"/></geometry>'
FAULTS = {
    "nan size": '<geometry><box size="nan 1 1"/></geometry>',
    "huge size": '<geometry><box size="1e300 1 1"/></geometry>',
    "negative size": '<geometry><sphere radius="-1"/></geometry>',
    "two sizes": '<geometry><box size="1 1"/></geometry>',
    "no size": "<geometry><box/></geometry>",
    "text size": '<geometry><box size="a b c"/></geometry>',
    "no length": '<geometry><cylinder radius="1"/></geometry>',
    "nan origin": f'<origin xyz="0 nan 0"/>{BOX}',
    "origin of text": f'<origin xyz="x y z"/>{BOX}',
    "short origin": f'<origin rpy="0 0"/>{BOX}',
    "infinite rpy": f'<origin rpy="inf 0 0"/>{BOX}',
    "nan colour": f'{BOX}<material name="m"><color rgba="nan 0 0 1"/></material>',
    "text colour": f'{BOX}<material name="m"><color rgba="red"/></material>',
    "colour of another": f'{BOX}<material name="bad"/>',
    "long name": f'<geometry><mesh filename="{"a" * 5000}.stl"/></geometry>',
    "deep name": f'<geometry><mesh filename="{"a/" * 3000}a.stl"/></geometry>',
    "escaped long name": f'<geometry><mesh filename="{"%61" * 80}{"b" * 200}.stl"/></geometry>',
    "no name": "<geometry><mesh/></geometry>",
    "text scale": '<geometry><mesh filename="a.stl" scale="x"/></geometry>',
    "infinite scale": '<geometry><mesh filename="a.stl" scale="1 1 inf"/></geometry>',
    "unknown shape": "<geometry><capsule/></geometry>",
    "no geometry": "<origin/>",
    "empty geometry": "<geometry/>",
}
MORE = '<material name="bad"><color rgba="1 2"/></material>'


@pytest.mark.parametrize("fault", FAULTS)
def test_a_visual_that_cannot_be_drawn_is_named_once_and_a_capsule_is_drawn(fault, tmp_path):
    robot = bare_robot(tmp_path, f"<visual>{FAULTS[fault]}</visual>", MORE)
    with pytest.warns(UserWarning, match="is drawn as a capsule") as caught:
        visuals = link_visuals(robot)
    assert len(caught) == 1
    assert "link 'a</script>'" in str(caught[0].message)
    assert len(str(caught[0].message)) < 1000
    assert STEEL in {visual.color for visual in visuals if visual.link == "a</script>"}
    assert all(np.isfinite(visual.vertices).all() and np.isfinite(visual.placement).all() for visual in visuals)
    with pytest.warns(UserWarning, match="capsule"):
        assert replay(moving_run(robot), tmp_path / "page.html", robot).stat().st_size > 1000


def test_what_can_be_drawn_beside_a_fault_is_drawn(tmp_path):
    robot = bare_robot(tmp_path, f"<visual>{BOX}</visual><visual>{FAULTS['nan size']}</visual>")
    with pytest.warns(UserWarning, match="nan 1 1"):
        corners = [visual.vertices for visual in link_visuals(robot) if visual.link == "a</script>"]
    assert any(np.abs(vertices).max() == 0.5 for vertices in corners)


def test_transmissions_are_no_matter_of_drawings(tmp_path):
    more = """<transmission name="gear"><joint name="j"/><actuator name="m">
      <mechanicalReduction>x</mechanicalReduction></actuator></transmission>"""
    robot = bare_robot(tmp_path, f"<visual><!-- a box -->{BOX}</visual>", more)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert link_visuals(robot)
    with pytest.raises(RobotError, match="mechanicalReduction"):
        read_couplings(robot)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(FAULTS)), st.text("0123456789.eE+-naif, _", max_size=12))
def test_numbers_of_any_text_give_finite_shapes(tmp_path_factory, fault, text):
    visual = FAULTS[fault].replace("nan", text.replace("<", ""))
    robot = bare_robot(tmp_path_factory.mktemp("any"), f"<visual>{visual}</visual>", MORE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        assert all(np.isfinite(shape.vertices).all() for shape in link_visuals(robot))


DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh><source id="p">
<float_array id="pa" count="9">0 0 0 1 0 0 0 1 0</float_array><technique_common>
<accessor source="#pa" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry>
</library_geometries><library_nodes>{nodes}</library_nodes><library_visual_scenes><visual_scene id="s">
<node id="root"><instance_node url="#n{last}"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def doubled(depth):
    """A COLLADA file in which every node places the one before it twice."""
    first = '<node id="n0"><instance_geometry url="#g"/></node>'
    twice = [f'<node id="n{k}">{2 * f"""<instance_node url="#n{k - 1}"/>"""}</node>' for k in range(1, depth + 1)]
    return DAE.format(nodes=first + "".join(twice), last=depth)


def test_small_meshes_with_many_parts_are_refused_before_they_are_unfolded(tmp_path):
    groups = "".join(f"g a{k}\nv {k} 0 0\nv {k} 1 0\nv {k} 0 1\nf -1 -2 -3\n" for k in range(40_000))
    solids = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
    (tmp_path / "groups.obj").write_text(groups)
    (tmp_path / "solids.stl").write_text(f"{solids}endfacet\nendsolid\n" * 40_000)
    (tmp_path / "nodes.dae").write_text(doubled(60))
    (tmp_path / "circle.dae").write_text(doubled(1).replace('url="#n0"', 'url="#n1"'))
    for name in ("groups.obj", "solids.stl", "nodes.dae", "circle.dae"):
        with pytest.raises(MeshError, match=f"at most {MAX_GROUPS} are drawn"):
            read_mesh(tmp_path / name, np.ones(3))
    (tmp_path / "few.dae").write_text(doubled(3))
    assert sum(len(part.faces) for part in read_mesh(tmp_path / "few.dae", np.ones(3))) == 8


@pytest.mark.parametrize("line", ["v 1e300 0 0", "f 1 2 99", "f 1 2 -99"])
def test_meshes_with_impossible_numbers_are_refused(line, tmp_path):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{line}\nf 1 2 3\nf 2 3 4\n")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        with pytest.raises(MeshError):
            read_mesh(tmp_path / "a.obj", np.ones(3))
