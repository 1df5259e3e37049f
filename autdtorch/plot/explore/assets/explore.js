// Parts of the live view that only the page can do: dark mode, shortcuts, copying, and the picture's label.
(() => {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");

  function tell() {
    const trame = window.trame;
    if (!trame?.state?.set) {
      setTimeout(tell, 50);
      return;
    }
    trame.state.set("dark", dark.matches);
  }
  dark.addEventListener("change", tell);
  tell();

  // The page that trame serves forbids zooming, and its picture has no text: the frame around it has.
  document.querySelector("meta[name=viewport]").content = "width=device-width, initial-scale=1";
  new MutationObserver(() => {
    for (const image of document.querySelectorAll(".view img:not([alt])")) image.alt = "";
  }).observe(document.body, { childList: true, subtree: true });

  document.addEventListener("keydown", (event) => {
    const typing = event.target.matches("input[type=text], input[type=number]");
    if (typing || !(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z") return;
    event.preventDefault();
    document.getElementById(event.shiftKey ? "redo" : "undo")?.click();
  });

  document.addEventListener("click", (event) => {
    const source = document.getElementById(event.target.dataset?.copy);
    if (source) navigator.clipboard?.writeText(source.textContent);
  });
})();
