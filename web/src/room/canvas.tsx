/** The picture of the room: keeps the viewer and the room's state in step. */

import { effect } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { asProblem, request, wasAborted } from "../api/client";
import { cloudPath, instancesCloudPath } from "../api/service";
import type { Problem } from "../api/types";
import { amend, route } from "../route";
import { isDark } from "../theme";
import { t } from "../text";
import { ProblemNote } from "../ui/problem";
import { readCloud, readInstances } from "../view3d/cloud";
import { offerHook } from "../view3d/hook";
import { EYE_HEIGHT_M, Viewer } from "../view3d/viewer";
import { readPose, writePose } from "./camera-link";
import { Labels } from "./labels";
import { usePointing } from "./pointing";
import { around, type Room } from "./state";

/** What has arrived of a cloud is drawn after this share, and then whenever there is so much more: each time costs all of it. */
const FIRST_SHARE = 0.02;
const MORE = 1.7;

export function RoomCanvas({ room, onReady }: { room: Room; onReady: (showWhole: () => void) => void }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const [viewer, setViewer] = useState<Viewer | null>(null);
  const [problem, setProblem] = useState<Problem | null>(null);
  const [arrived, setArrived] = useState<number | null>(0);
  const [broken, setBroken] = useState(false);

  useEffect(() => {
    let made: Viewer;
    try {
      made = new Viewer(canvas.current!);
    } catch {
      return setBroken(true);
    }
    setViewer(made);
    onReady(() => {
      room.walking.value = false;
      made.controls.flyTo(made.controls.home);
    });
    const stop = new AbortController();
    const loaded = { points: 0, instances: false };
    offerHook(made, canvas.current!, () => loaded);
    void loadCloud(room, made, stop.signal, (share) => setArrived(share), loaded).catch((thrown) => {
      if (!stop.signal.aborted && !wasAborted(thrown)) setProblem(asProblem(thrown));
    });
    const effects = keepInStep(room, made);
    return () => {
      stop.abort();
      effects.forEach((end) => end());
      delete window.unigroundPage;
      made.dispose();
    };
  }, []);

  usePointing(viewer, canvas, room);

  return (
    <div class="canvas">
      <canvas
        ref={canvas}
        tabIndex={0}
        role="application"
        aria-label={t.room.canvas(room.scene.value?.name ?? "")}
        aria-describedby="canvas-help"
        data-tool={room.tool.value}
      />
      <p id="canvas-help" class="offscreen">
        {t.room.canvasHelp}
      </p>
      {viewer && <Labels viewer={viewer} room={room} />}
      {broken && <p class="over">{t.room.noWebgl}</p>}
      {!broken && arrived !== null && !problem && (
        <p class="over" role="status">
          {t.room.loadingCloud(arrived)}
        </p>
      )}
      {problem && (
        <div class="over">
          <ProblemNote problem={problem} />
        </div>
      )}
    </div>
  );
}

/** Points first, for the eye; whose they are afterwards. */
async function loadCloud(
  room: Room,
  viewer: Viewer,
  signal: AbortSignal,
  onShare: (share: number | null) => void,
  loaded: { points: number; instances: boolean },
): Promise<void> {
  const scene = room.scene.peek()!;
  const response = await request(cloudPath(room.id), { signal });
  const total = Number(response.headers.get("content-length"));
  let bytes = 0;
  const counted = response.body!.pipeThrough(
    new TransformStream<Uint8Array, Uint8Array>({
      transform(chunk, controller) {
        bytes += chunk.length;
        controller.enqueue(chunk);
      },
    }),
  );
  let due = FIRST_SHARE;
  viewer.loading = true;
  const cloud = await readCloud(
    counted,
    (empty) => {
      viewer.load(empty, scene.extent!, room.instances.peek());
      viewer.colour(room.colouring.peek());
      viewer.light(room.lit.peek(), room.tinted.peek());
      startView(room, viewer);
    },
    () => {
      const share = total ? bytes / total : 0;
      if (share < due) return;
      due = share * MORE;
      onShare(share);
      viewer.arrived("points");
    },
  );
  viewer.loading = false;
  viewer.arrived("points");
  loaded.points = cloud.count;
  onShare(null);
  const instances = await request(instancesCloudPath(room.id), { signal });
  loaded.instances = await readInstances(instances.body!, cloud);
  viewer.arrived("instances");
}

function startView(room: Room, viewer: Viewer): void {
  const linked = readPose(route.peek().parameters.get("cam"));
  if (linked) {
    viewer.controls.walking = linked.walking;
    room.walking.value = linked.walking;
    viewer.goTo(linked.pose);
    return;
  }
  viewer.goTo(viewer.controls.home);
  const boxes = room.boxes.peek().filter(({ role }) => role === "answer" || role === "selected").map(({ box }) => box);
  if (boxes.length) viewer.frame(around(boxes));
}

function keepInStep(room: Room, viewer: Viewer): (() => void)[] {
  room.frame = (box) => {
    room.walking.value = false;
    viewer.frame(box);
  };
  let noting = 0;
  let noted = "";
  viewer.onDrawn = () => {
    // A link made from the address bar has the view in it.
    clearTimeout(noting);
    noting = window.setTimeout(() => {
      const cam = writePose(viewer.controls.pose, viewer.controls.walking);
      const atHome = cam === writePose(viewer.controls.home, false);
      if (cam !== noted && !viewer.controls.moving) amend({ cam: atHome ? null : cam });
      noted = cam;
    }, 400);
  };
  return [
    () => clearTimeout(noting),
    effect(() => {
      isDark();
      viewer.background(getComputedStyle(document.documentElement).getPropertyValue("--canvas").trim());
    }),
    effect(() => viewer.colour(room.colouring.value)),
    effect(() => viewer.showBoxes(room.boxes.value)),
    effect(() => viewer.light(room.lit.value, room.tinted.value)),
    effect(() => viewer.cut(room.cutWalls.value, room.cutHeight.value)),
    effect(() => viewer.measure(room.ends.value)),
    effect(() => {
      const observer = room.observer.value;
      const onFloor = observer && [observer.position[0]!, observer.position[1]!, room.floor()];
      viewer.stand(onFloor && { ...observer, position: onFloor });
    }),
    effect(() => viewer.controls.walk(room.walking.value, room.floor() + EYE_HEIGHT_M)),
  ];
}
