/* What every part of the page uses. Text from the log goes into the page as text only. */
"use strict";
const $ = (id) => document.getElementById(id);
const make = (tag, text, properties) => {
  const node = Object.assign(document.createElement(tag), properties);
  if (text !== undefined) node.textContent = text;
  return node;
};
