/** An open room: the 3D view, and the panels beside or below it. In narrow windows the question comes first. */

import { useEffect, useMemo, useRef } from "preact/hooks";
import { amend, route } from "../route";
import { t } from "../text";
import { narrow } from "../ui/narrow";
import { ProblemNote } from "../ui/problem";
import { panelId, tabId, Tabs } from "../ui/tabs";
import { AskForm, AskPanel } from "./ask";
import { RoomCanvas } from "./canvas";
import { Improving } from "./improving";
import { Photograph, PhotosPanel } from "./photos";
import { ReportPanel } from "./report";
import { Room, TABS } from "./state";
import { ThingsPanel } from "./things";
import { ToolHint, Toolbar, ViewMenu } from "./toolbar";
import { WaitingRoom } from "./waiting";
import { WhyPanel } from "./why";

export function RoomPlace({ scene: id }: { scene: string }) {
  const room = useMemo(() => new Room(id), [id]);
  const showWhole = useRef<() => void>(() => undefined);

  useEffect(() => {
    const stop = new AbortController();
    void room.load(stop.signal);
    return () => stop.abort();
  }, [room]);

  const scene = room.scene.value;
  useEffect(() => {
    if (scene) document.title = `${scene.name} · ${t.title}`;
  }, [scene]);

  // Back and forward go through the answers.
  const linked = route.value.parameters.get("answer");
  useEffect(() => {
    if (!room.scene.peek() || linked === (room.answer.peek()?.id ?? null)) return;
    if (linked) void room.open(linked);
    else room.answer.value = null;
  }, [linked]);

  // A thing that was clicked in the picture is told about where things are listed, and so are several.
  const selected = room.selected.value;
  const several = room.group.value.length > 0;
  useEffect(() => {
    if (several || (selected !== null && ["report", "photos"].includes(room.tab.peek()))) amend({ tab: "things" });
  }, [selected, several]);

  if (room.problem.value) return <ProblemNote problem={room.problem.value} onAgain={() => location.reload()} />;
  if (!scene) return <p class="wait">{t.loading}</p>;
  if (scene.status !== "ready") return <WaitingRoom room={room} onReady={() => void room.load(new AbortController().signal)} />;
  if (!room.loaded.value) return <p class="wait">{t.loading}</p>;

  const tab = room.tab.value;
  return (
    <div class="room">
      {narrow.value && <AskForm room={room} />}
      <section class="stage" aria-label={scene.name}>
        <h1 class="room-name">{scene.name}</h1>
        <Improving room={room} />
        <RoomCanvas key={scene.parse_version} room={room} onReady={(whole) => (showWhole.current = whole)} />
        <ToolHint room={room} />
        {narrow.value ? (
          <ViewMenu room={room} onWhole={() => showWhole.current()} />
        ) : (
          <Toolbar room={room} onWhole={() => showWhole.current()} />
        )}
      </section>
      <section class="side">
        <Tabs label={t.room.tabs.label} names={TABS} texts={t.room.tabs} chosen={tab} onChoose={(name) => amend({ tab: name })} />
        <div class="panel" role="tabpanel" id={panelId(tab)} aria-labelledby={tabId(tab)} tabIndex={0}>
          {tab === "ask" && <AskPanel room={room} />}
          {tab === "why" && <WhyPanel room={room} />}
          {tab === "things" && <ThingsPanel room={room} />}
          {tab === "photos" && <PhotosPanel room={room} />}
          {tab === "report" && <ReportPanel room={room} />}
        </div>
      </section>
      <Photograph room={room} />
    </div>
  );
}
