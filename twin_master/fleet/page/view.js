// Puts the page of the fleet in the place of the old one when it has changed, and stays where it was scrolled to.
"use strict";
let version = new URL(document.currentScript.src).searchParams.get("version");

async function look() {
  try {
    const now = await (await fetch("/version")).text();
    if (now !== version) {
      const text = await (await fetch("/")).text();
      const fresh = new DOMParser().parseFromString(text, "text/html");
      fresh.querySelectorAll("script").forEach((script) => script.remove());
      document.body.replaceChildren(...fresh.body.childNodes);
      version = now;
    }
  } catch {
    // The view has ended, or the machine sleeps: what is shown stays.
  }
}

setInterval(look, 1000);
