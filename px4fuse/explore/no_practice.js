/* Empty replacement of practice.js for px4fuse explore, whose page asks no questions. */
const Practice = { suffix: "", start() {} };
