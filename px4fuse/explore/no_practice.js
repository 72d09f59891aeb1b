/* A page that asks nothing. */
const Practice = { suffix: "", hidden: false, toAddress: () => ({}), start() {} };
