/** The cloud of a room whose scan is being parsed. It can be turned; nothing in it is known yet. */

import { effect } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { pointsFile } from "../api/points";
import type { Aabb } from "../api/types";
import { isDark } from "../theme";
import { t } from "../text";
import { type Cloud, readCloud } from "../view3d/cloud";
import { offerHook } from "../view3d/hook";
import { Viewer } from "../view3d/viewer";

export function DraftCanvas({ scene, onShown }: { scene: string; onShown: () => void }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useEffect(() => {
    const stop = new AbortController();
    let end = () => undefined as void;
    // Without a draft, or without WebGL, the room shows its progress only.
    void loadDraft(scene, stop.signal)
      .then((cloud) => {
        if (!cloud || stop.signal.aborted) return;
        end = show(canvas.current!, cloud);
        onShown();
      })
      .catch(() => undefined);
    return () => {
      stop.abort();
      end();
    };
  }, [scene]);
  return <canvas ref={canvas} role="img" aria-label={t.scenes.draftCanvas} />;
}

async function loadDraft(scene: string, signal: AbortSignal): Promise<Cloud | null> {
  let cloud: Cloud | null = null;
  await readCloud(pointsFile(scene, signal, true), (empty) => (cloud = empty), () => undefined);
  return cloud;
}

function show(canvas: HTMLCanvasElement, cloud: Cloud): () => void {
  const viewer = new Viewer(canvas);
  offerHook(viewer, canvas);
  viewer.load(cloud, extentOf(cloud), new Map());
  viewer.color("photograph");
  const end = effect(() => {
    isDark();
    viewer.background(getComputedStyle(document.documentElement).getPropertyValue("--canvas").trim());
  });
  viewer.goTo(viewer.controls.home);
  viewer.arrived();
  return () => {
    end();
    delete window.unigroundPage;
    viewer.dispose();
  };
}

function extentOf(cloud: Cloud): Aabb {
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  for (let i = 0; i < cloud.arrived; i++) {
    cloud.position(i).forEach((at, axis) => {
      low[axis] = Math.min(low[axis]!, at);
      high[axis] = Math.max(high[axis]!, at);
    });
  }
  return { center: low.map((at, axis) => (at + high[axis]!) / 2), size: low.map((at, axis) => high[axis]! - at) };
}
