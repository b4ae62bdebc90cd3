/** Tabs as the ARIA practices have them: one stop for Tab, arrows move between them. */

interface Properties<Name extends string> {
  label: string;
  names: readonly Name[];
  texts: Record<Name, string>;
  chosen: Name;
  onChoose: (name: Name) => void;
}

export const tabId = (name: string) => `tab-${name}`;
export const panelId = (name: string) => `panel-${name}`;

export function Tabs<Name extends string>({ label, names, texts, chosen, onChoose }: Properties<Name>) {
  const move = (event: KeyboardEvent) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const next = names[(names.indexOf(chosen) + step + names.length) % names.length]!;
    onChoose(next);
    document.getElementById(tabId(next))?.focus();
  };
  return (
    <div class="tabs" role="tablist" aria-label={label} onKeyDown={move}>
      {names.map((name) => (
        <button
          type="button"
          key={name}
          role="tab"
          id={tabId(name)}
          aria-controls={panelId(name)}
          aria-selected={name === chosen}
          tabIndex={name === chosen ? 0 : -1}
          onClick={() => onChoose(name)}
        >
          {texts[name]}
        </button>
      ))}
    </div>
  );
}
