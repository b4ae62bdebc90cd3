/** The picture of the room: keeps the viewer and the room's state in step. */

import { effect } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { asProblem, wasAborted } from "../api/client";
import { pointsFile } from "../api/points";
import type { Problem } from "../api/types";
import { amend, route } from "../route";
import { isDark } from "../theme";
import { t } from "../text";
import { ProblemNote } from "../ui/problem";
import { readCloud } from "../view3d/cloud";
import { offerHook } from "../view3d/hook";
import { EYE_HEIGHT_M, Viewer } from "../view3d/viewer";
import { readPose, writePose } from "./camera-link";
import { Labels } from "./labels";
import { usePointing } from "./pointing";
import { around, type Room } from "./state";

/** So many points are worth a picture, and then so many times as many. */
const FIRST_POINTS = 50_000;
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
    offerHook(made, canvas.current!);
    void loadCloud(room, made, stop.signal, setArrived).catch((thrown) => {
      if (!stop.signal.aborted && !wasAborted(thrown)) setProblem(asProblem(thrown));
    });
    const effects = keepInStep(room, made, canvas.current!);
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
        data-over={room.photographs.hovered.value !== null}
      />
      <p id="canvas-help" class="offscreen">
        {t.room.canvasHelp}
      </p>
      {viewer && <Labels viewer={viewer} room={room} />}
      {broken && <p class="over">{t.room.noWebgl}</p>}
      {!broken && arrived !== null && !problem && (
        <p class={arrived ? "over aside" : "over"} role="status">
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

/** Drawn whenever there is so much more of it, so that a slow connection is seen to bring something, and a fast one costs no time. */
async function loadCloud(room: Room, viewer: Viewer, signal: AbortSignal, onShare: (share: number | null) => void): Promise<void> {
  let due = FIRST_POINTS;
  await readCloud(
    pointsFile(room.id, signal),
    (empty) => {
      viewer.load(empty, room.scene.peek()!.extent!, room.instances.peek());
      know(room, viewer);
      viewer.color(room.coloring.peek());
      startView(room, viewer);
    },
    ({ arrived, count }) => {
      if (arrived < due && arrived < count) return;
      due = arrived * MORE;
      onShare(arrived < count ? arrived / count : null);
      viewer.arrived();
    },
  );
}

const know = (room: Room, viewer: Viewer) => viewer.know(room.instances.value, (cut) => room.standing(cut));

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

function keepInStep(room: Room, viewer: Viewer, canvas: HTMLCanvasElement): (() => void)[] {
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
    effect(() => viewer.color(room.coloring.value)),
    effect(() => viewer.showBoxes(room.boxes.value)),
    effect(() => know(room, viewer)),
    effect(() => viewer.light(room.lit.value, room.tinted.value)),
    effect(() => viewer.cut(room.cutWalls.value, room.cutHeight.value)),
    effect(() => viewer.showFrames(room.photographs.shown.value ? room.photographs.chosen.value : [])),
    effect(() => viewer.highlightFrame(room.photographs.frame(room.photographs.hovered.value))),
    effect(() => viewer.measure(room.measured.value)),
    effect(() => {
      const observer = room.observer.value;
      const onFloor = observer && [observer.position[0]!, observer.position[1]!, room.floor()];
      viewer.stand(onFloor && { ...observer, position: onFloor });
    }),
    effect(() => {
      const walking = room.walking.value;
      viewer.controls.walk(walking, room.floor() + EYE_HEIGHT_M, walking ? room.focus() : null);
      // Keys work at once.
      if (walking) canvas.focus({ preventScroll: true });
    }),
  ];
}
