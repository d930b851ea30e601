"use strict";
// An arm and its translucent reference, by meshcat, moved by the clock.
//   createScene(box, run, clock, room): `room()` is how much of the box panels cover: {left, top, bottom} [px].
// Without WebGL it is one sentence, and everything that it can do does nothing.

const NO_3D = "This browser draws no 3-D pictures, as WebGL is missing or switched off; the charts and numbers are complete without them.";

function createScene(box, run, clock, room = () => ({left: 0, top: 0, bottom: 0})) {
  const data = run.scene, times = decoded(data.times, Float64Array);
  const poses = decoded(data.poses, Float32Array);   // frame, arm, body, (x y z, qx qy qz qw)
  const bodies = data.bodies;

  function between(time) {   // two frames and where between them the time is
    const a = lastBefore(times, time), b = Math.min(a + 1, times.length - 1);
    return [a, b, b > a ? Math.min(1, Math.max(0, (time - times[a]) / (times[b] - times[a]))) : 0];
  }
  const shared = {
    step(n) { return times[Math.min(times.length - 1, Math.max(0, lastBefore(times, clock.now) + n))]; },
  };

  if (!document.createElement("canvas").getContext("webgl2") && !document.createElement("canvas").getContext("webgl")) {
    box.innerHTML = `<p class="absent">${NO_3D}</p>`;
    const nothing = () => {};
    return {...shared, is3D: false, aim: nothing, showGhost: nothing, showTraces: nothing, chooseTip: nothing, picture: nothing, canvas: null, pose: () => null, shown: () => []};
  }

  // --- meshcat's commands in order, then light, ground and the reference arm
  const THREE = MeshCat.THREE, viewer = new MeshCat.Viewer(box);
  viewer.set_3d_pane_size = () => MeshCat.Viewer.prototype.set_3d_pane_size.call(viewer, box.clientWidth, box.clientHeight);
  for (const command of data.commands) viewer.handle_command_bytearray(decoded(command, Uint8Array));
  const radius = data.view.radius;
  const actual = viewer.scene_tree.find(["actual"]).object, ghost = actual.clone(true);
  viewer.scene.add(ghost);
  const groups = [actual, ghost].map((arm) => bodies.map((name) => arm.children.find((child) => child.name === name)));
  const skin = new THREE.MeshPhongMaterial({emissiveIntensity: .25, transparent: true, opacity: .42, depthWrite: false,
    polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 8});

  function dressGhost() {
    // The first pass writes depth alone, so that only the ghost's outer surface shows; the offset lets the actual arm
    // win where both coincide.
    const depth = new THREE.MeshBasicMaterial({colorWrite: false, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 8});
    const meshes = [];
    ghost.traverse((object) => { if (object.isMesh) meshes.push(object); });
    for (const mesh of meshes) {
      mesh.castShadow = mesh.receiveShadow = false;
      const veil = mesh.clone();
      mesh.material = depth;
      veil.material = skin;
      mesh.renderOrder = 1;
      veil.renderOrder = 2;
      mesh.parent.add(veil);
    }
  }

  function light() {
    for (const name of ["Lights", "Grid", "Axes"]) viewer.delete_path([name]);
    viewer.scene.add(new THREE.HemisphereLight(0xffffff, 0xc4ccd4, .74));
    const [x, y, z] = data.view.target, key = new THREE.DirectionalLight(0xffffff, .52);
    const side = new THREE.Vector3(...data.view.direction).cross(new THREE.Vector3(0, 0, 1)).normalize();
    const toward = new THREE.Vector3(...data.view.direction).addScaledVector(side, -.9).setZ(1.6).normalize();
    key.position.set(x, y, z).addScaledVector(toward, 4 * radius);
    key.target.position.set(x, y, z);
    key.castShadow = true;
    key.shadow.mapSize.set(2048, 2048);
    key.shadow.normalBias = .004 * radius;
    Object.assign(key.shadow.camera, {left: -1.6 * radius, right: 1.6 * radius, top: 1.6 * radius, bottom: -1.6 * radius,
      near: radius, far: 9 * radius});
    const rim = new THREE.DirectionalLight(0xdfeaff, .22);
    rim.position.set(x, y, z).addScaledVector(toward, -4 * radius).setZ(z + radius);
    rim.target = key.target;
    viewer.scene.add(key, key.target, rim);
  }

  function layGround() {
    // A disc of cells that fades outward, in pieces of one cell (some drivers drop lines that pass behind the camera).
    const cell = data.view.cell, reach = 4.5 * radius, count = Math.ceil(reach / cell), points = [], colors = [];
    const add = (x, y, strength) => {
      points.push(x, y, 0);
      colors.push(.43, .50, .57, strength * Math.max(0, 1 - (x * x + y * y) / (reach * reach)));
    };
    for (let i = -count; i <= count; i++) {
      for (let j = -count; j < count; j++) {
        const strength = i % 5 ? .28 : .62;
        add(i * cell, j * cell, strength); add(i * cell, (j + 1) * cell, strength);
        add(j * cell, i * cell, strength); add((j + 1) * cell, i * cell, strength);
      }
    }
    const lines = new THREE.BufferGeometry();
    lines.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
    lines.setAttribute("color", new THREE.Float32BufferAttribute(colors, 4));
    const grid = new THREE.LineSegments(lines,
      new THREE.LineBasicMaterial({vertexColors: true, transparent: true, depthWrite: false}));
    const shadow = new THREE.Mesh(new THREE.PlaneGeometry(2 * reach, 2 * reach),
      new THREE.ShadowMaterial({opacity: .17, depthWrite: false}));
    shadow.receiveShadow = true;
    viewer.scene.add(grid, shadow);
  }

  // --- what the plant carries besides the arm, while it does
  const loads = data.loads.map(({body, point, radius: size, from, until}) => {
    const ball = new THREE.Mesh(new THREE.SphereGeometry(size, 32, 20), new THREE.MeshPhongMaterial({color: 0x7a4fa3, specular: 0x2a2a2a}));
    ball.position.fromArray(point);
    ball.castShadow = ball.receiveShadow = true;
    groups[0][body].add(ball);
    return {ball, from, until};
  });

  // --- the traces of the tip: where it was, and the path or the trace of the reference
  const dark = new THREE.LineBasicMaterial({transparent: true, opacity: .9});
  const pale = new THREE.LineBasicMaterial({transparent: true, opacity: .55});
  let traces = [], ghostShown = true, tracesShown = true;

  function trace(tip, arm, material) {
    const point = new THREE.Vector3(), turn = new THREE.Quaternion(), points = new Float32Array(3 * times.length);
    for (let frame = 0; frame < times.length; frame++) {
      const at = 7 * ((2 * frame + arm) * bodies.length + tip.body);
      point.fromArray(tip.point).applyQuaternion(turn.fromArray(poses, at + 3));
      for (let k = 0; k < 3; k++) points[3 * frame + k] = point.getComponent(k) + poses[at + k];
    }
    const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(points, 3));
    const line = new THREE.Line(geometry, material);
    line.frustumCulled = false;
    return line;
  }
  const tube = data.path ? pathTube(decoded(data.path, Float32Array)) : null;
  function pathTube(points) {   // a path of the tool as it was asked for
    const along = Array.from({length: points.length / 3}, (_, k) => new THREE.Vector3().fromArray(points, 3 * k));
    if (along.length < 2) return null;
    const geometry = new THREE.TubeGeometry(new THREE.CatmullRomCurve3(along), Math.min(along.length, 1000), .0025 * radius, 6);
    return new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({color: themed("--path"), transparent: true, opacity: .8}));
  }
  function chooseTip(k) {
    const tip = data.tips[k];
    viewer.scene.remove(...traces);
    traces = [trace(tip, 0, dark), k === 0 && tube ? tube : trace(tip, 1, pale)];
    viewer.scene.add(...traces);
    uncover();
    show();
  }
  function uncover() {   // the trace of the reference belongs to both switches; the path that was asked for, to one
    ghost.visible = ghostShown;
    traces[0].visible = tracesShown;
    traces[1].visible = tracesShown && (ghostShown || traces[1] === tube);
    viewer.set_dirty();
  }

  function dress() {
    const shades = (name) => { const of = new THREE.Color(themed(name)); return [of.r, of.g, of.b]; };
    viewer.set_property(["Background"], "top_color", shades("--sky"));
    viewer.set_property(["Background"], "bottom_color", shades("--ground"));
    skin.color.set(themed("--reference"));
    skin.emissive.set(themed("--reference"));
    dark.color.set(themed("--ink"));
    pale.color.set(themed("--reference"));
    viewer.set_dirty();
  }

  let moved = false;
  function aim() {   // the part of the box that no panel covers shows the whole motion, as close as it fits
    const {left, top, bottom} = room(), width = box.clientWidth, height = box.clientHeight;
    if (!width || !height) return;
    const camera = viewer.camera, controls = viewer.controls;
    if (!moved) {
      const slope = Math.tan(15 * Math.PI / 180);
      const high = .9 * slope * Math.max(.2, (height - bottom - top) / height), wide = .9 * slope * Math.max(.2 * width, width - left) / height;
      const upright = ([x, y, z]) => new THREE.Vector3(x, z, -y);   // the viewer's camera lives in a y-up frame
      const toward = upright(data.view.direction), right = new THREE.Vector3(0, 1, 0).cross(toward).normalize();
      const up = toward.clone().cross(right), cloud = data.view.cloud.map(upright);
      const target = upright(data.view.target);
      for (const axis of [right, up]) {
        const along = cloud.map((p) => p.dot(axis));
        target.addScaledVector(axis, (Math.min(...along) + Math.max(...along)) / 2 - target.dot(axis));
      }
      const distance = Math.max(...cloud.map((p) => {
        const d = p.clone().sub(target);
        return d.dot(toward) + Math.max(Math.abs(d.dot(right)) / wide, Math.abs(d.dot(up)) / high);
      }));
      Object.assign(camera, {fov: 30, near: distance / 100, far: distance * 100});
      controls.target.copy(target);
      camera.position.copy(target).addScaledVector(toward, distance);
    }
    camera.setViewOffset(width, height, -left / 2, (bottom - top) / 2, width, height);
    viewer.set_3d_pane_size();
  }

  const point = new THREE.Vector3(), turn = new THREE.Quaternion();
  function show() {
    const [a, b, part] = between(clock.now);
    groups.forEach((arm, k) => arm.forEach((group, body) => {
      const i = 7 * ((2 * a + k) * bodies.length + body), j = 7 * ((2 * b + k) * bodies.length + body);
      group.position.fromArray(poses, i).lerp(point.fromArray(poses, j), part);
      group.quaternion.fromArray(poses, i + 3).slerp(turn.fromArray(poses, j + 3), part);
    }));
    for (const {ball, from, until} of loads) ball.visible = clock.now >= from && (until === null || clock.now < until);
    traces[0].geometry.setDrawRange(0, a + 1);
    viewer.set_dirty();
  }

  dressGhost();
  light();
  layGround();
  dress();
  chooseTip(0);
  aim();
  clock.on(show);
  onTheme(dress);
  viewer.controls.addEventListener("start", () => { moved = true; });
  new ResizeObserver(aim).observe(box);

  return {
    ...shared, is3D: true, chooseTip, aim(again = false) { moved &&= !again; aim(); },
    showGhost(is) { ghostShown = is; uncover(); },
    showTraces(is) { tracesShown = is; uncover(); },
    shown: () => [ghost, ...traces].map((object) => object.visible),
    canvas: viewer.renderer.domElement,
    picture(done) { viewer.render(); viewer.renderer.domElement.toBlob(done, "image/png"); },
    pose(link, arm = "actual") {   // the link's pose in the robot's base frame, 16 numbers, column-major
      const [body, placement] = data.links[link];
      viewer.scene.updateMatrixWorld(true);
      const base = viewer.scene.matrixWorld.clone().invert();
      const group = groups[arm === "reference" ? 1 : 0][body];
      return base.multiply(group.matrixWorld).multiply(new THREE.Matrix4().fromArray(placement)).toArray();
    },
  };
}

// A video of the canvas while the clock plays from the beginning of its window to the end, in the first kind that the
// browser can write; its name ends as its kind does. `say` is told what is going on, "" when it is over.
function record(canvas, clock, name, say) {
  const kinds = ["video/mp4;codecs=avc1.42E01F", "video/mp4", "video/webm;codecs=vp9", "video/webm"];
  const kind = window.MediaRecorder && canvas.captureStream && kinds.find((type) => MediaRecorder.isTypeSupported(type));
  if (!kind) { say("this browser cannot record videos"); return null; }
  const recorder = new MediaRecorder(canvas.captureStream(30), {mimeType: kind, videoBitsPerSecond: 8e6}), parts = [];
  recorder.ondataavailable = (event) => parts.push(event.data);
  recorder.onstop = () => {
    clock.atEnd = null;
    clock.pause();
    const type = recorder.mimeType.split(";")[0];
    save(new Blob(parts, {type}), `${name}.${type.split("/")[1]}`);
    say("");
  };
  clock.seek(clock.from);
  recorder.start();
  say(`recording ${((clock.to - clock.from) / clock.speed).toFixed(0)} s; press again to stop`);
  clock.atEnd = () => setTimeout(() => recorder.state === "recording" && recorder.stop(), 100);
  clock.play();
  return recorder;
}
