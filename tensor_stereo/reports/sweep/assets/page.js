"use strict";
// Tables that sort by a click on a heading and filter by text and by lists; one page of rows is in the document at a
// time. Pictures that a click enlarges.
(() => {
  const ROWS = 50;
  const LONG = 60; // characters, from which a text may break
  const collator = new Intl.Collator("en", { numeric: true, sensitivity: "base" });

  const element = (name, attributes = {}, ...children) => {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children);
    return made;
  };

  // what a cell shows
  const text = (column, row) => {
    const value = column.values[row];
    if (column.texts) return column.texts[value];
    if (value === null) return column.none;
    if (column.decimals === null) return String(value);
    const digits = { minimumFractionDigits: column.decimals, maximumFractionDigits: column.decimals };
    const sign = column.kind === "signed" ? { signDisplay: "exceptZero" } : {};
    return value.toLocaleString("en", { ...digits, ...sign });
  };

  // what a column sorts by: texts by their rank, numbers as they are, null for no value
  const sortKeys = (column) => {
    if (!column.texts) return column.values;
    const order = column.texts.map((_, k) => k).sort((a, b) => collator.compare(column.texts[a], column.texts[b]));
    const rank = [];
    order.forEach((k, place) => {
      const same = place > 0 && collator.compare(column.texts[order[place - 1]], column.texts[k]) === 0;
      rank[k] = same ? rank[order[place - 1]] : place;
    });
    return column.values.map((k) => rank[k]);
  };

  class DataTable {
    constructor({ id, caption, columns }) {
      this.columns = columns;
      this.looks = columns.map((_, k) => this.look(k));
      this.count = columns[0].values.length;
      this.order = Array.from({ length: this.count }, (_, row) => row);
      this.page = 0;
      this.sorted = null; // [column, ascending]
      this.chosen = new Map(); // column -> the one text that it must show
      this.words = [];
      this.body = element("tbody");
      this.status = element("span", { role: "status", "aria-live": "polite" });
      this.back = this.turn("Previous", -1);
      this.next = this.turn("Next", 1);
      this.heads = [];
      this.region = element("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption });
      const title = element("caption", { class: "hidden" }, caption);
      this.region.append(element("table", {}, title, this.header(), this.body));
      const pager = element("div", { class: "pager" }, this.back, this.next, this.status, " Click a heading to sort.");
      document.getElementById(`table-${id}`).replaceChildren(this.controls(caption), this.region, pager);
      this.filter();
    }

    turn(label, step) {
      const button = element("button", { type: "button" }, label);
      button.addEventListener("click", () => {
        this.page += step;
        this.draw();
      });
      return button;
    }

    header() {
      const head = element("thead");
      if (this.columns.some((column) => column.group)) head.append(this.groups());
      const row = element("tr");
      this.columns.forEach((column, k) => {
        const button = element("button", { type: "button" }, column.heading);
        button.addEventListener("click", () => this.sort(k));
        const cell = element("th", { scope: "col", "aria-sort": "none", class: this.looks[k] }, button);
        this.heads.push(cell);
        row.append(cell);
      });
      head.append(row);
      return head;
    }

    groups() {
      const row = element("tr");
      for (let k = 0; k < this.columns.length; ) {
        const { group } = this.columns[k];
        let stop = k + 1;
        while (stop < this.columns.length && this.columns[stop].group === group) stop += 1;
        const span = { colspan: stop - k, class: group ? "group start" : "group" };
        row.append(group ? element("th", { ...span, scope: "colgroup" }, group) : element("td", span));
        k = stop;
      }
      return row;
    }

    look(k) {
      const { texts, group } = this.columns[k];
      const first = k > 0 && this.columns[k - 1].group !== group;
      const long = texts && texts.some((each) => each.length > LONG);
      return [texts ? "" : "number", first ? "start" : "", long ? "long" : ""].filter(Boolean).join(" ");
    }

    controls(caption) {
      const bar = element("div", { class: "controls" });
      this.searched = this.columns.filter((column) => column.texts);
      if (this.searched.length) {
        const input = element("input", { type: "search", placeholder: "words, all of which occur" });
        input.addEventListener("input", () => {
          this.words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
          this.filter();
        });
        bar.append(element("label", {}, `Filter ${caption.toLowerCase()}`, input));
      }
      for (const column of this.columns.filter((each) => each.select)) bar.append(this.choice(column));
      return bar;
    }

    choice(column) {
      const select = element("select", {}, element("option", { value: "" }, "all"));
      const keys = sortKeys(column);
      const shown = new Map(); // text -> key
      for (let row = 0; row < this.count; row += 1) shown.set(text(column, row), keys[row]);
      const options = [...shown].sort(([, a], [, b]) => (a === null) - (b === null) || a - b);
      options.forEach(([label], k) => select.append(element("option", { value: k + 1 }, label)));
      select.addEventListener("change", () => {
        if (select.value) this.chosen.set(column, options[select.value - 1][0]);
        else this.chosen.delete(column);
        this.filter();
      });
      return element("label", {}, column.heading, select);
    }

    passes(row) {
      for (const [column, wanted] of this.chosen) if (text(column, row) !== wanted) return false;
      if (!this.words.length) return true;
      const all = this.searched.map((column) => text(column, row)).join("\n").toLowerCase();
      return this.words.every((word) => all.includes(word));
    }

    filter() {
      this.shown = this.order.filter((row) => this.passes(row));
      this.page = 0;
      this.draw();
    }

    sort(k) {
      const ascending = !(this.sorted && this.sorted[0] === k && this.sorted[1]);
      this.sorted = [k, ascending];
      const keys = sortKeys(this.columns[k]);
      const sign = ascending ? 1 : -1;
      // equal keys keep the order of the data; rows without a value come last either way
      this.order.sort((a, b) => {
        const [x, y] = [keys[a], keys[b]];
        if (x === null || y === null) return (x === null) - (y === null) || a - b;
        return sign * (x - y) || a - b;
      });
      this.heads.forEach((head, j) => {
        head.setAttribute("aria-sort", j === k ? (ascending ? "ascending" : "descending") : "none");
      });
      this.filter();
    }

    draw() {
      const start = this.page * ROWS;
      const rows = this.shown.slice(start, start + ROWS);
      this.body.replaceChildren(...rows.map((row) => this.row(row)));
      this.region.scrollTop = 0;
      const total = this.shown.length.toLocaleString("en");
      const of = this.shown.length < this.count ? ` (${this.count.toLocaleString("en")} without filter)` : "";
      const span = rows.length ? `${(start + 1).toLocaleString("en")} to ${(start + rows.length).toLocaleString("en")} of ` : "";
      this.status.textContent = `Rows ${span}${total}${of}`;
      this.back.disabled = this.page === 0;
      this.next.disabled = start + ROWS >= this.shown.length;
    }

    row(row) {
      const cells = this.columns.map((column, k) => {
        const cell = element("td", { class: this.looks[k] }, text(column, row));
        if (column.kind === "rate" && column.values[row] !== null) {
          cell.classList.add("rate");
          cell.style.setProperty("--part", column.values[row]);
        }
        return cell;
      });
      return element("tr", {}, ...cells);
    }
  }

  for (const button of document.querySelectorAll(".overlays button")) {
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", button.getAttribute("aria-pressed") === "false");
    });
  }
  for (const table of JSON.parse(document.getElementById("data").textContent)) new DataTable(table);
})();
