/** The frame around every place of the page. */

import type { FunctionComponent } from "preact";
import { useEffect, useState } from "preact/hooks";
import { currentKey, keyWanted, serverHasKeys } from "./api/key";
import { BatchPlace } from "./batches/batch";
import { BatchesPlace } from "./batches/list";
import { KeyDialog } from "./key-dialog";
import { address, route } from "./route";
import { ScenesPlace } from "./scenes/list";
import { type Theme, theme } from "./theme";
import { t } from "./text";
import { Said } from "./ui/say";

type RoomPlace = FunctionComponent<{ scene: string }>;

/** The room brings three.js along: it is fetched when somebody opens one. */
let fetchedRoom: Promise<RoomPlace> | null = null;
const fetchRoom = () => (fetchedRoom ??= import("./room/place").then((module) => module.RoomPlace));

export function App() {
  const { path } = route.value;
  const [room, setRoom] = useState<RoomPlace | null>(null);
  const inRoom = path[0] === "scenes" && path[1] !== undefined;

  useEffect(() => {
    if (inRoom) void fetchRoom().then((fetched) => setRoom(() => fetched));
  }, [inRoom]);

  const Room = room;
  return (
    <>
      <a class="skip" href="#content" onClick={skip}>
        {t.skip}
      </a>
      <Head />
      <main id="content" tabIndex={-1} class={inRoom ? "room-main" : "page-main"}>
        {inRoom && Room && <Room key={path[1]} scene={path[1]!} />}
        {inRoom && !Room && <p class="wait">{t.loading}</p>}
        {path[0] === "batches" && (path[1] ? <BatchPlace key={path[1]} batch={path[1]} /> : <BatchesPlace />)}
        {!inRoom && path[0] !== "batches" && <ScenesPlace onReady={() => void fetchRoom()} />}
      </main>
      <Said />
    </>
  );
}

/** The address after `#` is taken by the page's own places. */
function skip(event: Event): void {
  event.preventDefault();
  document.getElementById("content")!.focus();
}

function Head() {
  const place = route.value.path[0] === "batches" ? "batches" : "scenes";
  const [asking, setAsking] = useState(false);
  const current = (name: string) => (place === name ? "page" : undefined);
  return (
    <header class="head">
      <a class="mark" href={address([])}>
        {t.title}
      </a>
      <nav aria-label={t.nav.label}>
        <a href={address([])} aria-current={current("scenes")}>
          {t.nav.scenes}
        </a>
        <a href={address(["batches"])} aria-current={current("batches")}>
          {t.nav.batches}
        </a>
        <a href="docs/" target="_blank" rel="noopener" title={t.nav.newTab}>
          {t.nav.api}
          <span class="offscreen"> ({t.nav.newTab})</span>
        </a>
      </nav>
      <span class="gap" />
      <label class="theme">
        <span>{t.theme.label}</span>
        <select value={theme.value} onChange={(event) => (theme.value = event.currentTarget.value as Theme)}>
          {(["auto", "light", "dark"] as const).map((name) => (
            <option key={name} value={name}>
              {t.theme[name]}
            </option>
          ))}
        </select>
      </label>
      {(currentKey() !== null || serverHasKeys.value) && (
        <button type="button" class="quiet" onClick={() => setAsking(true)}>
          {t.key.button}
        </button>
      )}
      {(asking || keyWanted.value !== null) && (
        <KeyDialog
          onClose={() => {
            setAsking(false);
            keyWanted.value = null;
          }}
        />
      )}
    </header>
  );
}
