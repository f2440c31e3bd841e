// A page whose sections are replaced when the server sends new ones; what the reader has chosen stays.
"use strict";
(() => {
  const { given, byId, start } = window.report;
  const main = document.querySelector("main"), { events, base } = document.body.dataset;
  const key = (one) => one.id || `${one.name || ""}=${one.value || ""}=${one.getAttribute("href") || ""}`;

  // What a reader has ticked, opened, scrolled to and stands on, put into the section that replaces another.
  const kept = (old, now) => {
    const ticked = new Set([...old.querySelectorAll("input:checked")].map(key));
    now.querySelectorAll("input[type=checkbox]").forEach((one) => { one.checked = ticked.has(key(one)); });
    const open = [...old.querySelectorAll("details")].map((one) => one.open);
    now.querySelectorAll("details").forEach((one, k) => { one.open = open[k] ?? one.open; });
    const scrolled = [...old.querySelectorAll(".scroll")].map((one) => one.scrollLeft);
    const focus = document.activeElement, stops = "a, input, button, select, summary, svg[tabindex]";
    const at = old.contains(focus) ? [...old.querySelectorAll(stops)].indexOf(focus) : -1;
    return () => {
      now.querySelectorAll(".scroll").forEach((one, k) => { one.scrollLeft = scrolled[k] || 0; });
      const found = [...now.querySelectorAll(stops)];
      if (at >= 0) (found.find((one) => one.id + one.value === focus.id + focus.value && key(one) === key(focus)) || found[at])?.focus({ preventScroll: true });
    };
  };

  const source = new EventSource(events);
  const say = (text, lost) => { byId("connection").textContent = text; byId("connection").className = lost ? "problem" : ""; };
  source.onopen = () => say("live", false);
  source.onerror = () => say("no connection to es-service watch; trying again", true);
  source.onmessage = (message) => {
    const { title, order, sections } = JSON.parse(message.data);
    document.title = title;
    document.querySelector("h1").textContent = title;
    let before = null;
    for (const name of order) {
      let section = byId(name);
      if (name in sections) {
        const { html, data } = sections[name];
        const box = document.createElement("div");
        box.innerHTML = html; // the server has escaped every text that it did not make
        const now = box.firstElementChild, old = section;
        Object.assign(given, data);
        const back = old ? kept(old, now) : () => {};
        if (old) old.replaceWith(now);
        section = now;
        if (!old) before ? before.after(now) : main.prepend(now);
        start[name]?.();
        back();
      }
      before = section;
    }
    [...main.children].forEach((one) => { if (!order.includes(one.id)) one.remove(); });
    document.body.dataset.pictures = Number(document.body.dataset.pictures || 0) + 1;
  };

  if (!base) return;
  const failed = async (answer) => `it could not be had: ${(await answer.text()).trim()}`;
  window.report.details = async (cell) => {
    const answer = await fetch(`${base}/cell/${cell}`);
    if (answer.ok) return answer.json();
    return { order: [], evaluate: await failed(answer) };
  };
  const library = (name) => window.THREE ? Promise.resolve() : new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = `/assets/${name}`;
    script.onload = resolve;
    script.onerror = reject;
    document.head.append(script);
  });
  let asked = 0, asking = new AbortController();
  const replay = async (which, what) => {
    const mine = ++asked, status = (text) => { if (mine === asked) byId("recording").textContent = text; };
    asking.abort(); // the server need not record what nobody waits for
    asking = new AbortController();
    status(`recording the episode of ${what} …`);
    try {
      const answer = await fetch(`${base}/replay/${which}`, { method: "POST", signal: asking.signal });
      if (!answer.ok) return status(await failed(answer));
      const { html, data } = await answer.json();
      if (data.replay?.solid) await library("three.bundle.js");
      if (mine !== asked) return; // another was chosen meanwhile
      given.replay = data.replay;
      byId("shown").innerHTML = html;
      status(`${what}`);
      start.replay();
    } catch (error) { status(`the server does not answer: ${error.message}`); }
  };
  document.addEventListener("taken", (event) => replay(event.detail, `cell ${byId("cell").textContent.split(":")[0]}`));
  document.addEventListener("click", ({ target }) => {
    if (target.matches("button.replay")) replay(target.value, target.textContent.replace("Replay ", ""));
  });
})();
