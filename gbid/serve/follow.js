// Asks for the state of the campaign and loads the page anew when a result has come; it stays where the reader is.
"use strict";

(() => {
  const EVERY = 3000;
  const words = document.getElementById("follow-words");
  const shown = /<!-- content_key: (\S*) -->/.exec(document.documentElement.innerHTML)?.[1] ?? "";
  const PLACE = "gbid-place";

  function told(stages) {
    const parts = Object.entries(stages).map(([stage, count]) => {
      const all = Object.values(count).reduce((a, b) => a + b, 0);
      const failed = count.failed ? `, ${count.failed} failed` : "";
      return `${stage} ${count.kept ?? 0} of ${all}${failed}`;
    });
    return parts.length ? `${parts.join("; ")}.` : "Nothing is planned yet.";
  }

  async function ask() {
    try {
      const answer = await fetch("state");
      if (!answer.ok) throw new Error(await answer.text());
      const state = await answer.json();
      words.textContent = told(state.stages);
      if (state.key !== shown) {
        sessionStorage.setItem(PLACE, String(window.scrollY));
        location.reload();
        return;
      }
    } catch (error) {
      words.textContent = `The server does not answer: ${error.message}`;
    }
    setTimeout(ask, EVERY);
  }

  const place = sessionStorage.getItem(PLACE);
  if (place !== null) {
    sessionStorage.removeItem(PLACE);
    window.scrollTo(0, Number(place));
  }
  ask();
})();
