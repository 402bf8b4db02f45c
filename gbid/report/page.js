// Starts the page. What goes wrong in it is listed on top, not hidden in the console.
"use strict";

function reportFault(text) {
  const list = document.getElementById("page-errors");
  list.hidden = false;
  list.appendChild(Object.assign(document.createElement("li"), { textContent: `This page has a fault: ${text}` }));
}

window.addEventListener("error", (event) => reportFault(event.message));
// On paper nothing can be opened.
window.addEventListener("beforeprint", () => {
  for (const fold of document.querySelectorAll("details")) fold.open = true;
});

window.addEventListener("unhandledrejection", (event) => reportFault(String(event.reason)));

document.addEventListener("DOMContentLoaded", () => {
  for (const part of [Fits, Explorer]) {
    try {
      part.start();
    } catch (error) {
      reportFault(`${error.name}: ${error.message}`);
    }
  }
});
