/* Helpers for DOM nodes. Text from the log becomes text nodes only, never HTML. */
"use strict";
const $ = (id) => document.getElementById(id);
const make = (tag, text, properties) => {
  const node = Object.assign(document.createElement(tag), properties);
  if (text !== undefined) node.textContent = text;
  return node;
};
