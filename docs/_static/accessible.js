// What Furo leaves out for screen readers and keyboards.
document.addEventListener("DOMContentLoaded", () => {
  for (const caption of document.querySelectorAll(".caption[role=heading]")) caption.setAttribute("aria-level", "2");
  const names = { ".sidebar-drawer": "all pages", ".toc-drawer": "on this page" };
  for (const [part, name] of Object.entries(names)) document.querySelector(part)?.setAttribute("aria-label", name);
  for (const code of document.querySelectorAll("pre, .table-wrapper")) code.tabIndex = 0;
});
