// Made of the modules of pincal/programs by tools/page_script.py.
const GRAMMARS = {};
GRAMMARS["\nstart: _NL* PROG _NL (HEAD? _NL)* MN _NL (line? _NL)* POS _NL (BODY? _NL)* END (_NL | _EOT)*\nline: LINE_NUMBER? KIND PLACE REST? -\u003e motion\n    | LINE_NUMBER? PLACE REST?      -\u003e more\n    | LINE_NUMBER? OTHER            -\u003e other\n    | LINE_NUMBER                   -\u003e other\nPROG.5: /\\/PROG[^\\r\\n]*/\nMN.5: /\\/MN(?![^\\s])/\nPOS.5: /\\/POS(?![^\\s])/\nEND.5: /\\/END(?![^\\s])/\nLINE_NUMBER.4: /\\d*:/\nKIND.3: /[JLCA](?=[ \\t]*PR?\\[)/\nPLACE.2: /PR?\\[[^\\]\\r\\n]*\\]/\nREST: /[^\\s\\x04][^\\r\\n\\x04]*/\nOTHER: /([^\\s\\/\\x04]|\\/\\/)[^\\r\\n\\x04]*/\nHEAD: /[^\\s\\x04][^\\r\\n\\x04]*/\nBODY: /[^\\s\\x04\\/][^\\r\\n\\x04]*/\n_NL: /\\r\\n|\\r|\\n/\n_EOT: \"\\x04\"\n%ignore /[ \\t\\f\\xa0]+/\n"] = {"start": 0, "names": ["PROG", "__IGNORE_0", "_NL", "MN", "HEAD", "POS", "LINE_NUMBER", "KIND", "PLACE", "OTHER", "REST", "END", "BODY", "_EOT"], "terminals": ["\\/PROG[^\r\n]*", "[ \t\f\u00a0]+", "\r\n|\r|\n", "\\/MN(?![^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0])", "[^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0\u0004][^\r\n\u0004]*", "\\/POS(?![^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0])", "\\d*:", "[JLCA](?=[ \t]*PR?\\[)", "PR?\\[[^\\]\r\n]*\\]", "([^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0\\/\u0004]|\\/\\/)[^\r\n\u0004]*", "[^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0\u0004][^\r\n\u0004]*", "\\/END(?![^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0])", "[^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0\u0004\\/][^\r\n\u0004]*", "\u0004"], "rules": [["__start_star_0", 1, "__start_star_0"], ["__start_star_0", 2, "__start_star_0"], ["__start_star_1", 1, "__start_star_1"], ["__start_star_1", 2, "__start_star_1"], ["__start_star_1", 2, "__start_star_1"], ["line", 1, "other"], ["line", 1, "other"], ["line", 1, "more"], ["__start_star_2", 1, "__start_star_2"], ["__start_star_1", 3, "__start_star_1"], ["line", 2, "motion"], ["line", 2, "other"], ["line", 2, "more"], ["line", 2, "more"], ["__start_star_2", 2, "__start_star_2"], ["__start_star_2", 2, "__start_star_2"], ["line", 3, "motion"], ["line", 3, "motion"], ["line", 3, "more"], ["start", 7, "start"], ["__start_star_3", 1, "__start_star_3"], ["__start_star_2", 3, "__start_star_2"], ["line", 4, "motion"], ["__start_star_3", 2, "__start_star_3"], ["__start_star_4", 1, "__start_star_4"], ["__start_star_4", 1, "__start_star_4"], ["start", 8, "start"], ["start", 8, "start"], ["__start_star_3", 2, "__start_star_3"], ["start", 8, "start"], ["start", 8, "start"], ["start", 8, "start"], ["__start_star_4", 2, "__start_star_4"], ["__start_star_4", 2, "__start_star_4"], ["__start_star_3", 3, "__start_star_3"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 9, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 10, "start"], ["start", 11, "start"], ["start", 11, "start"], ["start", 11, "start"], ["start", 11, "start"], ["start", 11, "start"], ["start", 12, "start"]], "states": [{"actions": {"PROG": [0, 1], "_NL": [0, 2], "__start_star_0": [0, 3], "start": [0, 4]}, "tried": [0, 1, 2]}, {"actions": {"_NL": [0, 5]}, "tried": [1, 2]}, {"actions": {"PROG": [1, 0], "_NL": [1, 0]}, "tried": [0, 1, 2]}, {"actions": {"PROG": [0, 6], "_NL": [0, 7]}, "tried": [0, 1, 2]}, {"actions": {}, "tried": [1]}, {"actions": {"HEAD": [0, 8], "MN": [0, 9], "_NL": [0, 10], "__start_star_1": [0, 11]}, "tried": [3, 4, 1, 2]}, {"actions": {"_NL": [0, 12]}, "tried": [1, 2]}, {"actions": {"PROG": [1, 1], "_NL": [1, 1]}, "tried": [0, 1, 2]}, {"actions": {"_NL": [0, 13]}, "tried": [1, 2]}, {"actions": {"_NL": [0, 14]}, "tried": [1, 2]}, {"actions": {"HEAD": [1, 2], "MN": [1, 2], "_NL": [1, 2]}, "tried": [3, 4, 1, 2]}, {"actions": {"HEAD": [0, 15], "MN": [0, 16], "_NL": [0, 17]}, "tried": [3, 4, 1, 2]}, {"actions": {"HEAD": [0, 8], "MN": [0, 18], "_NL": [0, 10], "__start_star_1": [0, 19]}, "tried": [3, 4, 1, 2]}, {"actions": {"HEAD": [1, 3], "MN": [1, 3], "_NL": [1, 3]}, "tried": [3, 4, 1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 24], "_NL": [0, 25], "__start_star_2": [0, 26], "line": [0, 27]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [0, 28]}, "tried": [1, 2]}, {"actions": {"_NL": [0, 29]}, "tried": [1, 2]}, {"actions": {"HEAD": [1, 4], "MN": [1, 4], "_NL": [1, 4]}, "tried": [3, 4, 1, 2]}, {"actions": {"_NL": [0, 30]}, "tried": [1, 2]}, {"actions": {"HEAD": [0, 15], "MN": [0, 31], "_NL": [0, 17]}, "tried": [3, 4, 1, 2]}, {"actions": {"PLACE": [0, 32]}, "tried": [8, 1]}, {"actions": {"KIND": [0, 33], "OTHER": [0, 34], "PLACE": [0, 35], "_NL": [1, 5]}, "tried": [7, 8, 9, 1, 2]}, {"actions": {"_NL": [1, 6]}, "tried": [1, 2]}, {"actions": {"REST": [0, 36], "_NL": [1, 7]}, "tried": [10, 1, 2]}, {"actions": {"_NL": [0, 37]}, "tried": [1, 2]}, {"actions": {"KIND": [1, 8], "LINE_NUMBER": [1, 8], "OTHER": [1, 8], "PLACE": [1, 8], "POS": [1, 8], "_NL": [1, 8]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 38], "_NL": [0, 39], "line": [0, 40]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [0, 41]}, "tried": [1, 2]}, {"actions": {"HEAD": [1, 9], "MN": [1, 9], "_NL": [1, 9]}, "tried": [3, 4, 1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 42], "_NL": [0, 25], "__start_star_2": [0, 43], "line": [0, 27]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 44], "_NL": [0, 25], "__start_star_2": [0, 45], "line": [0, 27]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [0, 46]}, "tried": [1, 2]}, {"actions": {"REST": [0, 47], "_NL": [1, 10]}, "tried": [10, 1, 2]}, {"actions": {"PLACE": [0, 48]}, "tried": [8, 1]}, {"actions": {"_NL": [1, 11]}, "tried": [1, 2]}, {"actions": {"REST": [0, 49], "_NL": [1, 12]}, "tried": [10, 1, 2]}, {"actions": {"_NL": [1, 13]}, "tried": [1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 51], "_NL": [0, 52], "__start_star_3": [0, 53]}, "tried": [11, 12, 1, 2]}, {"actions": {"_NL": [0, 54]}, "tried": [1, 2]}, {"actions": {"KIND": [1, 14], "LINE_NUMBER": [1, 14], "OTHER": [1, 14], "PLACE": [1, 14], "POS": [1, 14], "_NL": [1, 14]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [0, 55]}, "tried": [1, 2]}, {"actions": {"KIND": [1, 15], "LINE_NUMBER": [1, 15], "OTHER": [1, 15], "PLACE": [1, 15], "POS": [1, 15], "_NL": [1, 15]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [0, 56]}, "tried": [1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 57], "_NL": [0, 39], "line": [0, 40]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [0, 58]}, "tried": [1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 59], "_NL": [0, 39], "line": [0, 40]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 60], "_NL": [0, 25], "__start_star_2": [0, 61], "line": [0, 27]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [1, 16]}, "tried": [1, 2]}, {"actions": {"REST": [0, 62], "_NL": [1, 17]}, "tried": [10, 1, 2]}, {"actions": {"_NL": [1, 18]}, "tried": [1, 2]}, {"actions": {"_NL": [0, 63]}, "tried": [1, 2]}, {"actions": {"$END": [1, 19], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 66]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [1, 20], "END": [1, 20], "_NL": [1, 20]}, "tried": [11, 12, 1, 2]}, {"actions": {"BODY": [0, 67], "END": [0, 68], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 70], "_NL": [0, 52], "__start_star_3": [0, 71]}, "tried": [11, 12, 1, 2]}, {"actions": {"KIND": [1, 21], "LINE_NUMBER": [1, 21], "OTHER": [1, 21], "PLACE": [1, 21], "POS": [1, 21], "_NL": [1, 21]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 72], "_NL": [0, 52], "__start_star_3": [0, 73]}, "tried": [11, 12, 1, 2]}, {"actions": {"_NL": [0, 74]}, "tried": [1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 75], "_NL": [0, 52], "__start_star_3": [0, 76]}, "tried": [11, 12, 1, 2]}, {"actions": {"_NL": [0, 77]}, "tried": [1, 2]}, {"actions": {"_NL": [0, 78]}, "tried": [1, 2]}, {"actions": {"KIND": [0, 20], "LINE_NUMBER": [0, 21], "OTHER": [0, 22], "PLACE": [0, 23], "POS": [0, 79], "_NL": [0, 39], "line": [0, 40]}, "tried": [5, 6, 7, 8, 9, 1, 2]}, {"actions": {"_NL": [1, 22]}, "tried": [1, 2]}, {"actions": {"BODY": [1, 23], "END": [1, 23], "_NL": [1, 23]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 24], "_EOT": [1, 24], "_NL": [1, 24]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 25], "_EOT": [1, 25], "_NL": [1, 25]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 26], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"_NL": [0, 82]}, "tried": [1, 2]}, {"actions": {"$END": [1, 27], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 83]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [1, 28], "END": [1, 28], "_NL": [1, 28]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 29], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 84]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [0, 67], "END": [0, 85], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 30], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 86]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [0, 67], "END": [0, 87], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 88], "_NL": [0, 52], "__start_star_3": [0, 89]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 31], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 90]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [0, 67], "END": [0, 91], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 92], "_NL": [0, 52], "__start_star_3": [0, 93]}, "tried": [11, 12, 1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 94], "_NL": [0, 52], "__start_star_3": [0, 95]}, "tried": [11, 12, 1, 2]}, {"actions": {"_NL": [0, 96]}, "tried": [1, 2]}, {"actions": {"$END": [1, 32], "_EOT": [1, 32], "_NL": [1, 32]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 33], "_EOT": [1, 33], "_NL": [1, 33]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [1, 34], "END": [1, 34], "_NL": [1, 34]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 35], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 36], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 37], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 97]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 38], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 39], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 98]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 40], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 99]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [0, 67], "END": [0, 100], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 41], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 42], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 101]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 43], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 102]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [0, 67], "END": [0, 103], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 44], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 104]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [0, 67], "END": [0, 105], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"BODY": [0, 50], "END": [0, 106], "_NL": [0, 52], "__start_star_3": [0, 107]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 45], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 46], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 47], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 48], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 108]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 49], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 50], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 51], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 109]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 52], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 53], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 110]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 54], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 111]}, "tried": [1, 2, 13]}, {"actions": {"BODY": [0, 67], "END": [0, 112], "_NL": [0, 69]}, "tried": [11, 12, 1, 2]}, {"actions": {"$END": [1, 55], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 56], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 57], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 58], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 59], "_EOT": [0, 64], "_NL": [0, 65], "__start_star_4": [0, 113]}, "tried": [1, 2, 13]}, {"actions": {"$END": [1, 60], "_EOT": [0, 80], "_NL": [0, 81]}, "tried": [1, 2, 13]}], "hidden": ["_EOT", "_NL"], "ignored": ["__IGNORE_0"]};
GRAMMARS["\nstart: block* \"\\x04\"\nblock: PLACE \"{\" group+ \"}\" \";\"\ngroup: GROUP \"UF\" \":\" FRAME \",\" \"UT\" \":\" FRAME \",\" (configuration \",\")? value (\",\" value)*\nconfiguration: \"CONFIG\" \":\" \"'\" SIDE+ \",\" TURN \",\" TURN \",\" TURN \"'\"\nvalue: NAME \"=\" SIGNED UNIT\nPLACE: /P\\[[^\\]\\r\\n]*\\]/\nGROUP: /GP\\d+:/\nFRAME: /F|\\d+/\nSIDE: /[NFUDTBLR](?![A-Z])/\nTURN: /[+-]?\\d+/\nNAME: /J\\d+|E\\d+|[XYZWPR]/\nSIGNED: /[+-]?(\\d+(\\.\\d*)?|\\.\\d+)|\\*+/\nUNIT: \"mm\" | \"deg\"\n%ignore /[ \\t\\f\\xa0\\r\\n]+/\n"] = {"start": 0, "names": ["PLACE", "__IGNORE_0", "__ANON_0", "LBRACE", "GROUP", "UF", "RBRACE", "COLON", "SEMICOLON", "FRAME", "COMMA", "UT", "NAME", "CONFIG", "EQUAL", "QUOTE", "SIGNED", "SIDE", "UNIT", "TURN"], "terminals": ["P\\[[^\\]\r\n]*\\]", "[ \t\f\u00a0\r\n]+", "\u0004", "\\{", "GP\\d+:", "UF", "\\}", ":", ";", "F|\\d+", ",", "UT", "J\\d+|E\\d+|[XYZWPR]", "CONFIG", "=", "'", "[+-]?(\\d+(\\.\\d*)?|\\.\\d+)|\\*+", "[NFUDTBLR](?![A-Z])", "(?:deg|mm)", "[+-]?\\d+"], "rules": [["start", 1, "start"], ["__start_star_0", 1, "__start_star_0"], ["start", 2, "start"], ["__start_star_0", 2, "__start_star_0"], ["__block_plus_1", 1, "__block_plus_1"], ["__block_plus_1", 2, "__block_plus_1"], ["block", 5, "block"], ["group", 10, "group"], ["group", 11, "group"], ["group", 12, "group"], ["__group_star_2", 2, "__group_star_2"], ["__configuration_plus_3", 1, "__configuration_plus_3"], ["value", 4, "value"], ["group", 13, "group"], ["__group_star_2", 3, "__group_star_2"], ["__configuration_plus_3", 2, "__configuration_plus_3"], ["configuration", 11, "configuration"]], "states": [{"actions": {"PLACE": [0, 1], "__ANON_0": [0, 2], "__start_star_0": [0, 3], "block": [0, 4], "start": [0, 5]}, "tried": [0, 1, 2]}, {"actions": {"LBRACE": [0, 6]}, "tried": [1, 3]}, {"actions": {"$END": [1, 0]}, "tried": [1]}, {"actions": {"PLACE": [0, 1], "__ANON_0": [0, 7], "block": [0, 8]}, "tried": [0, 1, 2]}, {"actions": {"PLACE": [1, 1], "__ANON_0": [1, 1]}, "tried": [0, 1, 2]}, {"actions": {}, "tried": [1]}, {"actions": {"GROUP": [0, 9], "__block_plus_1": [0, 10], "group": [0, 11]}, "tried": [1, 4]}, {"actions": {"$END": [1, 2]}, "tried": [1]}, {"actions": {"PLACE": [1, 3], "__ANON_0": [1, 3]}, "tried": [0, 1, 2]}, {"actions": {"UF": [0, 12]}, "tried": [1, 5]}, {"actions": {"GROUP": [0, 9], "RBRACE": [0, 13], "group": [0, 14]}, "tried": [1, 4, 6]}, {"actions": {"GROUP": [1, 4], "RBRACE": [1, 4]}, "tried": [1, 4, 6]}, {"actions": {"COLON": [0, 15]}, "tried": [1, 7]}, {"actions": {"SEMICOLON": [0, 16]}, "tried": [1, 8]}, {"actions": {"GROUP": [1, 5], "RBRACE": [1, 5]}, "tried": [1, 4, 6]}, {"actions": {"FRAME": [0, 17]}, "tried": [1, 9]}, {"actions": {"PLACE": [1, 6], "__ANON_0": [1, 6]}, "tried": [0, 1, 2]}, {"actions": {"COMMA": [0, 18]}, "tried": [1, 10]}, {"actions": {"UT": [0, 19]}, "tried": [1, 11]}, {"actions": {"COLON": [0, 20]}, "tried": [1, 7]}, {"actions": {"FRAME": [0, 21]}, "tried": [1, 9]}, {"actions": {"COMMA": [0, 22]}, "tried": [1, 10]}, {"actions": {"CONFIG": [0, 23], "NAME": [0, 24], "configuration": [0, 25], "value": [0, 26]}, "tried": [12, 1, 13]}, {"actions": {"COLON": [0, 27]}, "tried": [1, 7]}, {"actions": {"EQUAL": [0, 28]}, "tried": [1, 14]}, {"actions": {"COMMA": [0, 29]}, "tried": [1, 10]}, {"actions": {"COMMA": [0, 30], "GROUP": [1, 7], "RBRACE": [1, 7], "__group_star_2": [0, 31]}, "tried": [1, 4, 10, 6]}, {"actions": {"QUOTE": [0, 32]}, "tried": [1, 15]}, {"actions": {"SIGNED": [0, 33]}, "tried": [16, 1]}, {"actions": {"NAME": [0, 24], "value": [0, 34]}, "tried": [12, 1]}, {"actions": {"NAME": [0, 24], "value": [0, 35]}, "tried": [12, 1]}, {"actions": {"COMMA": [0, 36], "GROUP": [1, 8], "RBRACE": [1, 8]}, "tried": [1, 4, 10, 6]}, {"actions": {"SIDE": [0, 37], "__configuration_plus_3": [0, 38]}, "tried": [1, 17]}, {"actions": {"UNIT": [0, 39]}, "tried": [1, 18]}, {"actions": {"COMMA": [0, 30], "GROUP": [1, 9], "RBRACE": [1, 9], "__group_star_2": [0, 40]}, "tried": [1, 4, 10, 6]}, {"actions": {"COMMA": [1, 10], "GROUP": [1, 10], "RBRACE": [1, 10]}, "tried": [1, 4, 10, 6]}, {"actions": {"NAME": [0, 24], "value": [0, 41]}, "tried": [12, 1]}, {"actions": {"COMMA": [1, 11], "SIDE": [1, 11]}, "tried": [1, 17, 10]}, {"actions": {"COMMA": [0, 42], "SIDE": [0, 43]}, "tried": [1, 17, 10]}, {"actions": {"COMMA": [1, 12], "GROUP": [1, 12], "RBRACE": [1, 12]}, "tried": [1, 4, 10, 6]}, {"actions": {"COMMA": [0, 36], "GROUP": [1, 13], "RBRACE": [1, 13]}, "tried": [1, 4, 10, 6]}, {"actions": {"COMMA": [1, 14], "GROUP": [1, 14], "RBRACE": [1, 14]}, "tried": [1, 4, 10, 6]}, {"actions": {"TURN": [0, 44]}, "tried": [1, 19]}, {"actions": {"COMMA": [1, 15], "SIDE": [1, 15]}, "tried": [1, 17, 10]}, {"actions": {"COMMA": [0, 45]}, "tried": [1, 10]}, {"actions": {"TURN": [0, 46]}, "tried": [1, 19]}, {"actions": {"COMMA": [0, 47]}, "tried": [1, 10]}, {"actions": {"TURN": [0, 48]}, "tried": [1, 19]}, {"actions": {"QUOTE": [0, 49]}, "tried": [1, 15]}, {"actions": {"COMMA": [1, 16]}, "tried": [1, 10]}], "hidden": ["COLON", "COMMA", "CONFIG", "EQUAL", "LBRACE", "QUOTE", "RBRACE", "SEMICOLON", "UF", "UT", "__ANON_0"], "ignored": ["__IGNORE_0"]};
GRAMMARS["\nstart: (COMMENT? _NL)* JOB _NL (_head? _NL)* INST _NL (_line? _NL)* (_line? _EOT)\n_head: tag | configuration | position | COMMENT\ntag: TAG REST?\nconfiguration: RCONF SIGNED (\",\" SIGNED)*\nposition: PLACE \"=\" SIGNED (\",\" SIGNED)*\n_line: motion | other | COMMENT\nmotion: MOVE PLACE REST?\nother: OTHER\nJOB.5: /\\/JOB(?![^\\s])/\nINST.5: /\\/\\/INST(?![^\\s])/\nRCONF.4: /\\/\\/\\/RCONF/\nTAG.3: /\\/{2,3}[A-Z][A-Z0-9]*/\nMOVE.3: /(MOV[JLCS]|IMOV)(?![A-Z0-9])/\nPLACE.3: /(BC|EC|BP|EX|C|P)\\d+|P\\[[^\\]\\r\\n]*\\]/\nSIGNED: /[+-]?(\\d+(\\.\\d*)?|\\.\\d+)/\nREST: /[^\\s\\x04'][^\\r\\n\\x04]*/\nOTHER: /[^\\s\\x04'][^\\r\\n\\x04]*/\nCOMMENT.4: /'[^\\r\\n]*/\n_NL: /\\r\\n|\\r|\\n/\n_EOT: \"\\x04\"\n%ignore /[ \\t\\f\\xa0]+/\n"] = {"start": 0, "names": ["JOB", "COMMENT", "__IGNORE_0", "_NL", "INST", "RCONF", "PLACE", "TAG", "EQUAL", "SIGNED", "REST", "MOVE", "OTHER", "_EOT", "COMMA"], "terminals": ["\\/JOB(?![^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0])", "'[^\r\n]*", "[ \t\f\u00a0]+", "\r\n|\r|\n", "\\/\\/INST(?![^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0])", "\\/\\/\\/RCONF", "(BC|EC|BP|EX|C|P)\\d+|P\\[[^\\]\r\n]*\\]", "\\/{2,3}[A-Z][A-Z0-9]*", "=", "[+-]?(\\d+(\\.\\d*)?|\\.\\d+)", "[^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0\u0004'][^\r\n\u0004]*", "(MOV[JLCS]|IMOV)(?![A-Z0-9])", "[^\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a0\u0004'][^\r\n\u0004]*", "\u0004", ","], "rules": [["__start_star_0", 1, "__start_star_0"], ["__start_star_0", 2, "__start_star_0"], ["__start_star_0", 2, "__start_star_0"], ["_head", 1, "_head"], ["tag", 1, "tag"], ["__start_star_1", 1, "__start_star_1"], ["_head", 1, "_head"], ["_head", 1, "_head"], ["_head", 1, "_head"], ["__start_star_0", 3, "__start_star_0"], ["configuration", 2, "configuration"], ["tag", 2, "tag"], ["__start_star_1", 2, "__start_star_1"], ["__start_star_1", 2, "__start_star_1"], ["_line", 1, "_line"], ["other", 1, "other"], ["start", 5, "start"], ["__start_star_2", 1, "__start_star_2"], ["_line", 1, "_line"], ["_line", 1, "_line"], ["position", 3, "position"], ["configuration", 3, "configuration"], ["__start_star_1", 3, "__start_star_1"], ["motion", 2, "motion"], ["start", 6, "start"], ["__start_star_2", 2, "__start_star_2"], ["start", 6, "start"], ["__start_star_2", 2, "__start_star_2"], ["position", 4, "position"], ["__configuration_star_3", 2, "__configuration_star_3"], ["start", 6, "start"], ["start", 6, "start"], ["motion", 3, "motion"], ["start", 7, "start"], ["__start_star_2", 3, "__start_star_2"], ["__configuration_star_3", 3, "__configuration_star_3"], ["start", 7, "start"], ["start", 7, "start"], ["start", 7, "start"], ["start", 7, "start"], ["start", 7, "start"], ["start", 8, "start"], ["start", 8, "start"], ["start", 8, "start"], ["start", 8, "start"], ["start", 9, "start"]], "states": [{"actions": {"COMMENT": [0, 1], "JOB": [0, 2], "_NL": [0, 3], "__start_star_0": [0, 4], "start": [0, 5]}, "tried": [0, 1, 2, 3]}, {"actions": {"_NL": [0, 6]}, "tried": [2, 3]}, {"actions": {"_NL": [0, 7]}, "tried": [2, 3]}, {"actions": {"COMMENT": [1, 0], "JOB": [1, 0], "_NL": [1, 0]}, "tried": [0, 1, 2, 3]}, {"actions": {"COMMENT": [0, 8], "JOB": [0, 9], "_NL": [0, 10]}, "tried": [0, 1, 2, 3]}, {"actions": {}, "tried": [2]}, {"actions": {"COMMENT": [1, 1], "JOB": [1, 1], "_NL": [1, 1]}, "tried": [0, 1, 2, 3]}, {"actions": {"COMMENT": [0, 11], "INST": [0, 12], "PLACE": [0, 13], "RCONF": [0, 14], "TAG": [0, 15], "_NL": [0, 16], "__start_star_1": [0, 17], "_head": [0, 18], "configuration": [0, 19], "position": [0, 20], "tag": [0, 21]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"_NL": [0, 22]}, "tried": [2, 3]}, {"actions": {"_NL": [0, 23]}, "tried": [2, 3]}, {"actions": {"COMMENT": [1, 2], "JOB": [1, 2], "_NL": [1, 2]}, "tried": [0, 1, 2, 3]}, {"actions": {"_NL": [1, 3]}, "tried": [2, 3]}, {"actions": {"_NL": [0, 24]}, "tried": [2, 3]}, {"actions": {"EQUAL": [0, 25]}, "tried": [2, 8]}, {"actions": {"SIGNED": [0, 26]}, "tried": [9, 2]}, {"actions": {"REST": [0, 27], "_NL": [1, 4]}, "tried": [10, 2, 3]}, {"actions": {"COMMENT": [1, 5], "INST": [1, 5], "PLACE": [1, 5], "RCONF": [1, 5], "TAG": [1, 5], "_NL": [1, 5]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"COMMENT": [0, 11], "INST": [0, 28], "PLACE": [0, 13], "RCONF": [0, 14], "TAG": [0, 15], "_NL": [0, 29], "_head": [0, 30], "configuration": [0, 19], "position": [0, 20], "tag": [0, 21]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"_NL": [0, 31]}, "tried": [2, 3]}, {"actions": {"_NL": [1, 6]}, "tried": [2, 3]}, {"actions": {"_NL": [1, 7]}, "tried": [2, 3]}, {"actions": {"_NL": [1, 8]}, "tried": [2, 3]}, {"actions": {"COMMENT": [1, 9], "JOB": [1, 9], "_NL": [1, 9]}, "tried": [0, 1, 2, 3]}, {"actions": {"COMMENT": [0, 11], "INST": [0, 32], "PLACE": [0, 13], "RCONF": [0, 14], "TAG": [0, 15], "_NL": [0, 16], "__start_star_1": [0, 33], "_head": [0, 18], "configuration": [0, 19], "position": [0, 20], "tag": [0, 21]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 37], "_NL": [0, 38], "__start_star_2": [0, 39], "_line": [0, 40], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"SIGNED": [0, 43]}, "tried": [9, 2]}, {"actions": {"COMMA": [0, 44], "_NL": [1, 10], "__configuration_star_3": [0, 45]}, "tried": [2, 3, 14]}, {"actions": {"_NL": [1, 11]}, "tried": [2, 3]}, {"actions": {"_NL": [0, 46]}, "tried": [2, 3]}, {"actions": {"COMMENT": [1, 12], "INST": [1, 12], "PLACE": [1, 12], "RCONF": [1, 12], "TAG": [1, 12], "_NL": [1, 12]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"_NL": [0, 47]}, "tried": [2, 3]}, {"actions": {"COMMENT": [1, 13], "INST": [1, 13], "PLACE": [1, 13], "RCONF": [1, 13], "TAG": [1, 13], "_NL": [1, 13]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"_NL": [0, 48]}, "tried": [2, 3]}, {"actions": {"COMMENT": [0, 11], "INST": [0, 49], "PLACE": [0, 13], "RCONF": [0, 14], "TAG": [0, 15], "_NL": [0, 29], "_head": [0, 30], "configuration": [0, 19], "position": [0, 20], "tag": [0, 21]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"_EOT": [1, 14], "_NL": [1, 14]}, "tried": [2, 3, 13]}, {"actions": {"PLACE": [0, 50]}, "tried": [6, 2]}, {"actions": {"_EOT": [1, 15], "_NL": [1, 15]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 16]}, "tried": [2]}, {"actions": {"COMMENT": [1, 17], "MOVE": [1, 17], "OTHER": [1, 17], "_EOT": [1, 17], "_NL": [1, 17]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 51], "_NL": [0, 52], "_line": [0, 53], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"_EOT": [0, 54], "_NL": [0, 55]}, "tried": [2, 3, 13]}, {"actions": {"_EOT": [1, 18], "_NL": [1, 18]}, "tried": [2, 3, 13]}, {"actions": {"_EOT": [1, 19], "_NL": [1, 19]}, "tried": [2, 3, 13]}, {"actions": {"COMMA": [0, 44], "_NL": [1, 20], "__configuration_star_3": [0, 56]}, "tried": [2, 3, 14]}, {"actions": {"SIGNED": [0, 57]}, "tried": [9, 2]}, {"actions": {"COMMA": [0, 58], "_NL": [1, 21]}, "tried": [2, 3, 14]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 59], "_NL": [0, 38], "__start_star_2": [0, 60], "_line": [0, 61], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"COMMENT": [1, 22], "INST": [1, 22], "PLACE": [1, 22], "RCONF": [1, 22], "TAG": [1, 22], "_NL": [1, 22]}, "tried": [4, 1, 5, 6, 7, 2, 3]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 62], "_NL": [0, 38], "__start_star_2": [0, 63], "_line": [0, 64], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"_NL": [0, 65]}, "tried": [2, 3]}, {"actions": {"REST": [0, 66], "_EOT": [1, 23], "_NL": [1, 23]}, "tried": [10, 2, 3, 13]}, {"actions": {"$END": [1, 24]}, "tried": [2]}, {"actions": {"COMMENT": [1, 25], "MOVE": [1, 25], "OTHER": [1, 25], "_EOT": [1, 25], "_NL": [1, 25]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"_EOT": [0, 67], "_NL": [0, 68]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 26]}, "tried": [2]}, {"actions": {"COMMENT": [1, 27], "MOVE": [1, 27], "OTHER": [1, 27], "_EOT": [1, 27], "_NL": [1, 27]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"COMMA": [0, 58], "_NL": [1, 28]}, "tried": [2, 3, 14]}, {"actions": {"COMMA": [1, 29], "_NL": [1, 29]}, "tried": [2, 3, 14]}, {"actions": {"SIGNED": [0, 69]}, "tried": [9, 2]}, {"actions": {"$END": [1, 30]}, "tried": [2]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 70], "_NL": [0, 52], "_line": [0, 71], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"_EOT": [0, 72], "_NL": [0, 55]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 31]}, "tried": [2]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 73], "_NL": [0, 52], "_line": [0, 74], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"_EOT": [0, 75], "_NL": [0, 55]}, "tried": [2, 3, 13]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 76], "_NL": [0, 38], "__start_star_2": [0, 77], "_line": [0, 78], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"_EOT": [1, 32], "_NL": [1, 32]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 33]}, "tried": [2]}, {"actions": {"COMMENT": [1, 34], "MOVE": [1, 34], "OTHER": [1, 34], "_EOT": [1, 34], "_NL": [1, 34]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"COMMA": [1, 35], "_NL": [1, 35]}, "tried": [2, 3, 14]}, {"actions": {"$END": [1, 36]}, "tried": [2]}, {"actions": {"_EOT": [0, 79], "_NL": [0, 68]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 37]}, "tried": [2]}, {"actions": {"$END": [1, 38]}, "tried": [2]}, {"actions": {"_EOT": [0, 80], "_NL": [0, 68]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 39]}, "tried": [2]}, {"actions": {"$END": [1, 40]}, "tried": [2]}, {"actions": {"COMMENT": [0, 34], "MOVE": [0, 35], "OTHER": [0, 36], "_EOT": [0, 81], "_NL": [0, 52], "_line": [0, 82], "motion": [0, 41], "other": [0, 42]}, "tried": [1, 11, 12, 2, 3, 13]}, {"actions": {"_EOT": [0, 83], "_NL": [0, 55]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 41]}, "tried": [2]}, {"actions": {"$END": [1, 42]}, "tried": [2]}, {"actions": {"$END": [1, 43]}, "tried": [2]}, {"actions": {"_EOT": [0, 84], "_NL": [0, 68]}, "tried": [2, 3, 13]}, {"actions": {"$END": [1, 44]}, "tried": [2]}, {"actions": {"$END": [1, 45]}, "tried": [2]}], "hidden": ["COMMA", "EQUAL", "_EOT", "_NL"], "ignored": ["__IGNORE_0"]};
GRAMMARS["\nstart: statement*\nstatement: _item* _END\n_item: WORD | NUMBER | BITS | TEXT | SIGN | group\ngroup: OPEN _inner* CLOSE\n_inner: _item\nOPEN: \"(\" | \"[\" | \"{\"\nCLOSE: \")\" | \"]\" | \"}\"\nNUMBER.2: /(\\d+(\\.\\d*)?|\\.\\d+)([eE][+-]?\\d+)?/\nWORD.1: /[A-Za-z_$#\\x80-\\xff][A-Za-z0-9_$\\x80-\\xff]*/\n\nTEXT: /\"[^\"\\r\\n]*\"/\nBITS.2: /'[BbHh][0-9A-Fa-f]+'/\nSIGN: /[=\u003c\u003e]=|[^\\x04\\s\\w()\\[\\]{}\"';&$#]|'/\n_END: /\\r\\n|\\r|\\n|\\x04/\nCOMMENT.5: /;[^\\r\\n]*/\nHEADER.5: /&[^\\r\\n]*/\n%ignore COMMENT\n%ignore HEADER\n%ignore /[ \\t\\f\\xa0]+/\n"] = {"start": 0, "names": ["COMMENT", "HEADER", "NUMBER", "BITS", "WORD", "TEXT", "__IGNORE_2", "SIGN", "_END", "OPEN", "CLOSE"], "terminals": [";[^\r\n]*", "\u0026[^\r\n]*", "(\\d+(\\.\\d*)?|\\.\\d+)([eE][+-]?\\d+)?", "'[BbHh][0-9A-Fa-f]+'", "[A-Za-z_$#\u0080-\u00ff][A-Za-z0-9_$\u0080-\u00ff]*", "\"[^\"\r\n]*\"", "[ \t\f\u00a0]+", "[=\u003c\u003e]=|[^\u0004\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a00-9A-Z_a-z\u00aa\u00b2\u00b3\u00b5\u00b9\u00ba\u00bc\u00bd\u00be\u00c0\u00c1\u00c2\u00c3\u00c4\u00c5\u00c6\u00c7\u00c8\u00c9\u00ca\u00cb\u00cc\u00cd\u00ce\u00cf\u00d0\u00d1\u00d2\u00d3\u00d4\u00d5\u00d6\u00d8\u00d9\u00da\u00db\u00dc\u00dd\u00de\u00df\u00e0\u00e1\u00e2\u00e3\u00e4\u00e5\u00e6\u00e7\u00e8\u00e9\u00ea\u00eb\u00ec\u00ed\u00ee\u00ef\u00f0\u00f1\u00f2\u00f3\u00f4\u00f5\u00f6\u00f8\u00f9\u00fa\u00fb\u00fc\u00fd\u00fe\u00ff()\\[\\]{}\"';\u0026$#]|'", "\r\n|\r|\n|\u0004", "(?:\\(|\\[|\\{)", "(?:\\)|\\]|\\})"], "rules": [["start", 0, "start"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["statement", 1, "statement"], ["start", 1, "start"], ["__statement_star_1", 1, "__statement_star_1"], ["_item", 1, "_item"], ["__start_star_0", 1, "__start_star_0"], ["group", 2, "group"], ["__group_star_2", 1, "__group_star_2"], ["_inner", 1, "_inner"], ["__start_star_0", 2, "__start_star_0"], ["statement", 2, "statement"], ["__statement_star_1", 2, "__statement_star_1"], ["group", 3, "group"], ["__group_star_2", 2, "__group_star_2"]], "states": [{"actions": {"$END": [1, 0], "BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 7], "__start_star_0": [0, 8], "__statement_star_1": [0, 9], "_item": [0, 10], "group": [0, 11], "start": [0, 12], "statement": [0, 13]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"BITS": [1, 1], "CLOSE": [1, 1], "NUMBER": [1, 1], "OPEN": [1, 1], "SIGN": [1, 1], "TEXT": [1, 1], "WORD": [1, 1], "_END": [1, 1]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {"BITS": [1, 2], "CLOSE": [1, 2], "NUMBER": [1, 2], "OPEN": [1, 2], "SIGN": [1, 2], "TEXT": [1, 2], "WORD": [1, 2], "_END": [1, 2]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {"BITS": [0, 1], "CLOSE": [0, 14], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "__group_star_2": [0, 15], "_inner": [0, 16], "_item": [0, 17], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 10, 9]}, {"actions": {"BITS": [1, 3], "CLOSE": [1, 3], "NUMBER": [1, 3], "OPEN": [1, 3], "SIGN": [1, 3], "TEXT": [1, 3], "WORD": [1, 3], "_END": [1, 3]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {"BITS": [1, 4], "CLOSE": [1, 4], "NUMBER": [1, 4], "OPEN": [1, 4], "SIGN": [1, 4], "TEXT": [1, 4], "WORD": [1, 4], "_END": [1, 4]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {"BITS": [1, 5], "CLOSE": [1, 5], "NUMBER": [1, 5], "OPEN": [1, 5], "SIGN": [1, 5], "TEXT": [1, 5], "WORD": [1, 5], "_END": [1, 5]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {"$END": [1, 6], "BITS": [1, 6], "NUMBER": [1, 6], "OPEN": [1, 6], "SIGN": [1, 6], "TEXT": [1, 6], "WORD": [1, 6], "_END": [1, 6]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"$END": [1, 7], "BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 7], "__statement_star_1": [0, 9], "_item": [0, 10], "group": [0, 11], "statement": [0, 18]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 19], "_item": [0, 20], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"BITS": [1, 8], "NUMBER": [1, 8], "OPEN": [1, 8], "SIGN": [1, 8], "TEXT": [1, 8], "WORD": [1, 8], "_END": [1, 8]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"BITS": [1, 9], "CLOSE": [1, 9], "NUMBER": [1, 9], "OPEN": [1, 9], "SIGN": [1, 9], "TEXT": [1, 9], "WORD": [1, 9], "_END": [1, 9]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {}, "tried": [0, 1, 6]}, {"actions": {"$END": [1, 10], "BITS": [1, 10], "NUMBER": [1, 10], "OPEN": [1, 10], "SIGN": [1, 10], "TEXT": [1, 10], "WORD": [1, 10], "_END": [1, 10]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"BITS": [1, 11], "CLOSE": [1, 11], "NUMBER": [1, 11], "OPEN": [1, 11], "SIGN": [1, 11], "TEXT": [1, 11], "WORD": [1, 11], "_END": [1, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {"BITS": [0, 1], "CLOSE": [0, 21], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_inner": [0, 22], "_item": [0, 17], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 10, 9]}, {"actions": {"BITS": [1, 12], "CLOSE": [1, 12], "NUMBER": [1, 12], "OPEN": [1, 12], "SIGN": [1, 12], "TEXT": [1, 12], "WORD": [1, 12]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 10, 9]}, {"actions": {"BITS": [1, 13], "CLOSE": [1, 13], "NUMBER": [1, 13], "OPEN": [1, 13], "SIGN": [1, 13], "TEXT": [1, 13], "WORD": [1, 13]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 10, 9]}, {"actions": {"$END": [1, 14], "BITS": [1, 14], "NUMBER": [1, 14], "OPEN": [1, 14], "SIGN": [1, 14], "TEXT": [1, 14], "WORD": [1, 14], "_END": [1, 14]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"$END": [1, 15], "BITS": [1, 15], "NUMBER": [1, 15], "OPEN": [1, 15], "SIGN": [1, 15], "TEXT": [1, 15], "WORD": [1, 15], "_END": [1, 15]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"BITS": [1, 16], "NUMBER": [1, 16], "OPEN": [1, 16], "SIGN": [1, 16], "TEXT": [1, 16], "WORD": [1, 16], "_END": [1, 16]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]}, {"actions": {"BITS": [1, 17], "CLOSE": [1, 17], "NUMBER": [1, 17], "OPEN": [1, 17], "SIGN": [1, 17], "TEXT": [1, 17], "WORD": [1, 17], "_END": [1, 17]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9]}, {"actions": {"BITS": [1, 18], "CLOSE": [1, 18], "NUMBER": [1, 18], "OPEN": [1, 18], "SIGN": [1, 18], "TEXT": [1, 18], "WORD": [1, 18]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 10, 9]}], "hidden": ["_END"], "ignored": ["COMMENT", "HEADER", "__IGNORE_2"]};
GRAMMARS["\nstart: statement*\nstatement: _item* _END\n_item: WORD | NUMBER | BITS | TEXT | SIGN | group\ngroup: OPEN _inner* CLOSE\n_inner: _item\nOPEN: \"(\" | \"[\" | \"{\"\nCLOSE: \")\" | \"]\" | \"}\"\nNUMBER.2: /(\\d+(\\.\\d*)?|\\.\\d+)([eE][+-]?\\d+)?/\nWORD.1: /[A-Za-z_$#\\x80-\\xff][A-Za-z0-9_$\\x80-\\xff]*/\n\nTEXT: /\"([^\"\\r\\n]|\"\")*\"/\nBITS.3: /\\x05/\nSIGN: /:=|[\u003c\u003e]=|[^\\x04\\s\\w()\\[\\]{}\"!;$#]/\n_END: \";\" | \"\\x04\"\nCOMMENT.5: /![^\\r\\n]*/\n%ignore COMMENT\n%ignore /[ \\t\\f\\r\\n\\xa0]+/\n"] = {"start": 0, "names": ["COMMENT", "BITS", "NUMBER", "WORD", "TEXT", "__IGNORE_1", "SIGN", "OPEN", "_END", "CLOSE"], "terminals": ["![^\r\n]*", "\u0005", "(\\d+(\\.\\d*)?|\\.\\d+)([eE][+-]?\\d+)?", "[A-Za-z_$#\u0080-\u00ff][A-Za-z0-9_$\u0080-\u00ff]*", "\"([^\"\r\n]|\"\")*\"", "[ \t\f\r\n\u00a0]+", ":=|[\u003c\u003e]=|[^\u0004\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a00-9A-Z_a-z\u00aa\u00b2\u00b3\u00b5\u00b9\u00ba\u00bc\u00bd\u00be\u00c0\u00c1\u00c2\u00c3\u00c4\u00c5\u00c6\u00c7\u00c8\u00c9\u00ca\u00cb\u00cc\u00cd\u00ce\u00cf\u00d0\u00d1\u00d2\u00d3\u00d4\u00d5\u00d6\u00d8\u00d9\u00da\u00db\u00dc\u00dd\u00de\u00df\u00e0\u00e1\u00e2\u00e3\u00e4\u00e5\u00e6\u00e7\u00e8\u00e9\u00ea\u00eb\u00ec\u00ed\u00ee\u00ef\u00f0\u00f1\u00f2\u00f3\u00f4\u00f5\u00f6\u00f8\u00f9\u00fa\u00fb\u00fc\u00fd\u00fe\u00ff()\\[\\]{}\"!;$#]", "(?:\\(|\\[|\\{)", "(?:;|\u0004)", "(?:\\)|\\]|\\})"], "rules": [["start", 0, "start"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["statement", 1, "statement"], ["start", 1, "start"], ["__statement_star_1", 1, "__statement_star_1"], ["_item", 1, "_item"], ["__start_star_0", 1, "__start_star_0"], ["group", 2, "group"], ["__group_star_2", 1, "__group_star_2"], ["_inner", 1, "_inner"], ["__start_star_0", 2, "__start_star_0"], ["statement", 2, "statement"], ["__statement_star_1", 2, "__statement_star_1"], ["group", 3, "group"], ["__group_star_2", 2, "__group_star_2"]], "states": [{"actions": {"$END": [1, 0], "BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 7], "__start_star_0": [0, 8], "__statement_star_1": [0, 9], "_item": [0, 10], "group": [0, 11], "start": [0, 12], "statement": [0, 13]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 1], "CLOSE": [1, 1], "NUMBER": [1, 1], "OPEN": [1, 1], "SIGN": [1, 1], "TEXT": [1, 1], "WORD": [1, 1], "_END": [1, 1]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {"BITS": [1, 2], "CLOSE": [1, 2], "NUMBER": [1, 2], "OPEN": [1, 2], "SIGN": [1, 2], "TEXT": [1, 2], "WORD": [1, 2], "_END": [1, 2]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {"BITS": [0, 1], "CLOSE": [0, 14], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "__group_star_2": [0, 15], "_inner": [0, 16], "_item": [0, 17], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7]}, {"actions": {"BITS": [1, 3], "CLOSE": [1, 3], "NUMBER": [1, 3], "OPEN": [1, 3], "SIGN": [1, 3], "TEXT": [1, 3], "WORD": [1, 3], "_END": [1, 3]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {"BITS": [1, 4], "CLOSE": [1, 4], "NUMBER": [1, 4], "OPEN": [1, 4], "SIGN": [1, 4], "TEXT": [1, 4], "WORD": [1, 4], "_END": [1, 4]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {"BITS": [1, 5], "CLOSE": [1, 5], "NUMBER": [1, 5], "OPEN": [1, 5], "SIGN": [1, 5], "TEXT": [1, 5], "WORD": [1, 5], "_END": [1, 5]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {"$END": [1, 6], "BITS": [1, 6], "NUMBER": [1, 6], "OPEN": [1, 6], "SIGN": [1, 6], "TEXT": [1, 6], "WORD": [1, 6], "_END": [1, 6]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"$END": [1, 7], "BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 7], "__statement_star_1": [0, 9], "_item": [0, 10], "group": [0, 11], "statement": [0, 18]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 19], "_item": [0, 20], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 8], "NUMBER": [1, 8], "OPEN": [1, 8], "SIGN": [1, 8], "TEXT": [1, 8], "WORD": [1, 8], "_END": [1, 8]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 9], "CLOSE": [1, 9], "NUMBER": [1, 9], "OPEN": [1, 9], "SIGN": [1, 9], "TEXT": [1, 9], "WORD": [1, 9], "_END": [1, 9]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {}, "tried": [0, 5]}, {"actions": {"$END": [1, 10], "BITS": [1, 10], "NUMBER": [1, 10], "OPEN": [1, 10], "SIGN": [1, 10], "TEXT": [1, 10], "WORD": [1, 10], "_END": [1, 10]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 11], "CLOSE": [1, 11], "NUMBER": [1, 11], "OPEN": [1, 11], "SIGN": [1, 11], "TEXT": [1, 11], "WORD": [1, 11], "_END": [1, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {"BITS": [0, 1], "CLOSE": [0, 21], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_inner": [0, 22], "_item": [0, 17], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7]}, {"actions": {"BITS": [1, 12], "CLOSE": [1, 12], "NUMBER": [1, 12], "OPEN": [1, 12], "SIGN": [1, 12], "TEXT": [1, 12], "WORD": [1, 12]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7]}, {"actions": {"BITS": [1, 13], "CLOSE": [1, 13], "NUMBER": [1, 13], "OPEN": [1, 13], "SIGN": [1, 13], "TEXT": [1, 13], "WORD": [1, 13]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7]}, {"actions": {"$END": [1, 14], "BITS": [1, 14], "NUMBER": [1, 14], "OPEN": [1, 14], "SIGN": [1, 14], "TEXT": [1, 14], "WORD": [1, 14], "_END": [1, 14]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"$END": [1, 15], "BITS": [1, 15], "NUMBER": [1, 15], "OPEN": [1, 15], "SIGN": [1, 15], "TEXT": [1, 15], "WORD": [1, 15], "_END": [1, 15]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 16], "NUMBER": [1, 16], "OPEN": [1, 16], "SIGN": [1, 16], "TEXT": [1, 16], "WORD": [1, 16], "_END": [1, 16]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 17], "CLOSE": [1, 17], "NUMBER": [1, 17], "OPEN": [1, 17], "SIGN": [1, 17], "TEXT": [1, 17], "WORD": [1, 17], "_END": [1, 17]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7, 8]}, {"actions": {"BITS": [1, 18], "CLOSE": [1, 18], "NUMBER": [1, 18], "OPEN": [1, 18], "SIGN": [1, 18], "TEXT": [1, 18], "WORD": [1, 18]}, "tried": [0, 1, 2, 3, 4, 5, 6, 9, 7]}], "hidden": ["_END"], "ignored": ["COMMENT", "__IGNORE_1"]};
GRAMMARS["\nstart: statement*\nstatement: _item* _END\n_item: WORD | NUMBER | BITS | TEXT | SIGN | group\ngroup: OPEN _inner* CLOSE\n_inner: _item | _END\nOPEN: \"(\" | \"[\" | \"{\"\nCLOSE: \")\" | \"]\" | \"}\"\nNUMBER.2: /(\\d+(\\.\\d*)?|\\.\\d+)([eE][+-]?\\d+)?/\nWORD.1: /[A-Za-z_$#\\x80-\\xff][A-Za-z0-9_$\\x80-\\xff]*/\n\nTEXT: /\"[^\"\\r\\n]*\"/ | /'[^'\\r\\n]*'/\nBITS.3: /0[xXbB][0-9a-fA-F]+/\nSIGN: /[=\u003c\u003e!]=|[^\\x04\\s\\w()\\[\\]{}\"'#$]/\n_END: /\\r\\n|\\r|\\n|\\x04/\nCOMMENT.5: /#[^\\r\\n]*/\n%ignore COMMENT\n%ignore /[ \\t\\f\\xa0]+/\n"] = {"start": 0, "names": ["COMMENT", "BITS", "NUMBER", "WORD", "TEXT", "__IGNORE_1", "SIGN", "_END", "OPEN", "CLOSE"], "terminals": ["#[^\r\n]*", "0[xXbB][0-9a-fA-F]+", "(\\d+(\\.\\d*)?|\\.\\d+)([eE][+-]?\\d+)?", "[A-Za-z_$#\u0080-\u00ff][A-Za-z0-9_$\u0080-\u00ff]*", "(?:\"[^\"\r\n]*\"|'[^'\r\n]*')", "[ \t\f\u00a0]+", "[=\u003c\u003e!]=|[^\u0004\t\n\u000b\f\r\u001c\u001d\u001e\u001f \u0085\u00a00-9A-Z_a-z\u00aa\u00b2\u00b3\u00b5\u00b9\u00ba\u00bc\u00bd\u00be\u00c0\u00c1\u00c2\u00c3\u00c4\u00c5\u00c6\u00c7\u00c8\u00c9\u00ca\u00cb\u00cc\u00cd\u00ce\u00cf\u00d0\u00d1\u00d2\u00d3\u00d4\u00d5\u00d6\u00d8\u00d9\u00da\u00db\u00dc\u00dd\u00de\u00df\u00e0\u00e1\u00e2\u00e3\u00e4\u00e5\u00e6\u00e7\u00e8\u00e9\u00ea\u00eb\u00ec\u00ed\u00ee\u00ef\u00f0\u00f1\u00f2\u00f3\u00f4\u00f5\u00f6\u00f8\u00f9\u00fa\u00fb\u00fc\u00fd\u00fe\u00ff()\\[\\]{}\"'#$]", "\r\n|\r|\n|\u0004", "(?:\\(|\\[|\\{)", "(?:\\)|\\]|\\})"], "rules": [["start", 0, "start"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["_item", 1, "_item"], ["statement", 1, "statement"], ["start", 1, "start"], ["__statement_star_1", 1, "__statement_star_1"], ["_item", 1, "_item"], ["__start_star_0", 1, "__start_star_0"], ["group", 2, "group"], ["_inner", 1, "_inner"], ["__group_star_2", 1, "__group_star_2"], ["_inner", 1, "_inner"], ["__start_star_0", 2, "__start_star_0"], ["statement", 2, "statement"], ["__statement_star_1", 2, "__statement_star_1"], ["group", 3, "group"], ["__group_star_2", 2, "__group_star_2"]], "states": [{"actions": {"$END": [1, 0], "BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 7], "__start_star_0": [0, 8], "__statement_star_1": [0, 9], "_item": [0, 10], "group": [0, 11], "start": [0, 12], "statement": [0, 13]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 1], "CLOSE": [1, 1], "NUMBER": [1, 1], "OPEN": [1, 1], "SIGN": [1, 1], "TEXT": [1, 1], "WORD": [1, 1], "_END": [1, 1]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 2], "CLOSE": [1, 2], "NUMBER": [1, 2], "OPEN": [1, 2], "SIGN": [1, 2], "TEXT": [1, 2], "WORD": [1, 2], "_END": [1, 2]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [0, 1], "CLOSE": [0, 14], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 15], "__group_star_2": [0, 16], "_inner": [0, 17], "_item": [0, 18], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 3], "CLOSE": [1, 3], "NUMBER": [1, 3], "OPEN": [1, 3], "SIGN": [1, 3], "TEXT": [1, 3], "WORD": [1, 3], "_END": [1, 3]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 4], "CLOSE": [1, 4], "NUMBER": [1, 4], "OPEN": [1, 4], "SIGN": [1, 4], "TEXT": [1, 4], "WORD": [1, 4], "_END": [1, 4]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 5], "CLOSE": [1, 5], "NUMBER": [1, 5], "OPEN": [1, 5], "SIGN": [1, 5], "TEXT": [1, 5], "WORD": [1, 5], "_END": [1, 5]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"$END": [1, 6], "BITS": [1, 6], "NUMBER": [1, 6], "OPEN": [1, 6], "SIGN": [1, 6], "TEXT": [1, 6], "WORD": [1, 6], "_END": [1, 6]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"$END": [1, 7], "BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 7], "__statement_star_1": [0, 9], "_item": [0, 10], "group": [0, 11], "statement": [0, 19]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [0, 1], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 20], "_item": [0, 21], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 8], "NUMBER": [1, 8], "OPEN": [1, 8], "SIGN": [1, 8], "TEXT": [1, 8], "WORD": [1, 8], "_END": [1, 8]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 9], "CLOSE": [1, 9], "NUMBER": [1, 9], "OPEN": [1, 9], "SIGN": [1, 9], "TEXT": [1, 9], "WORD": [1, 9], "_END": [1, 9]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {}, "tried": [0, 5]}, {"actions": {"$END": [1, 10], "BITS": [1, 10], "NUMBER": [1, 10], "OPEN": [1, 10], "SIGN": [1, 10], "TEXT": [1, 10], "WORD": [1, 10], "_END": [1, 10]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 11], "CLOSE": [1, 11], "NUMBER": [1, 11], "OPEN": [1, 11], "SIGN": [1, 11], "TEXT": [1, 11], "WORD": [1, 11], "_END": [1, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 12], "CLOSE": [1, 12], "NUMBER": [1, 12], "OPEN": [1, 12], "SIGN": [1, 12], "TEXT": [1, 12], "WORD": [1, 12], "_END": [1, 12]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [0, 1], "CLOSE": [0, 22], "NUMBER": [0, 2], "OPEN": [0, 3], "SIGN": [0, 4], "TEXT": [0, 5], "WORD": [0, 6], "_END": [0, 15], "_inner": [0, 23], "_item": [0, 18], "group": [0, 11]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 13], "CLOSE": [1, 13], "NUMBER": [1, 13], "OPEN": [1, 13], "SIGN": [1, 13], "TEXT": [1, 13], "WORD": [1, 13], "_END": [1, 13]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 14], "CLOSE": [1, 14], "NUMBER": [1, 14], "OPEN": [1, 14], "SIGN": [1, 14], "TEXT": [1, 14], "WORD": [1, 14], "_END": [1, 14]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"$END": [1, 15], "BITS": [1, 15], "NUMBER": [1, 15], "OPEN": [1, 15], "SIGN": [1, 15], "TEXT": [1, 15], "WORD": [1, 15], "_END": [1, 15]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"$END": [1, 16], "BITS": [1, 16], "NUMBER": [1, 16], "OPEN": [1, 16], "SIGN": [1, 16], "TEXT": [1, 16], "WORD": [1, 16], "_END": [1, 16]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 17], "NUMBER": [1, 17], "OPEN": [1, 17], "SIGN": [1, 17], "TEXT": [1, 17], "WORD": [1, 17], "_END": [1, 17]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 8]}, {"actions": {"BITS": [1, 18], "CLOSE": [1, 18], "NUMBER": [1, 18], "OPEN": [1, 18], "SIGN": [1, 18], "TEXT": [1, 18], "WORD": [1, 18], "_END": [1, 18]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}, {"actions": {"BITS": [1, 19], "CLOSE": [1, 19], "NUMBER": [1, 19], "OPEN": [1, 19], "SIGN": [1, 19], "TEXT": [1, 19], "WORD": [1, 19], "_END": [1, 19]}, "tried": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}], "hidden": ["_END"], "ignored": ["COMMENT", "__IGNORE_1"]};
MODULES.syntax = (() => {
let LARGEST_PROGRAM;
LARGEST_PROGRAM = 50000000;
let MOST_WORDS;
MOST_WORDS = 10000000;
let DEEPEST;
DEEPEST = 100;
let _NESTED;
_NESTED = "\nstart: statement*\nstatement: _item* _END\n_item: WORD | NUMBER | BITS | TEXT | SIGN | group\ngroup: OPEN _inner* CLOSE\n_inner: _item\nOPEN: \"(\" | \"[\" | \"{\"\nCLOSE: \")\" | \"]\" | \"}\"\nNUMBER.2: /(\\d+(\\.\\d*)?|\\.\\d+)([eE][+-]?\\d+)?/\nWORD.1: /[A-Za-z_$#\\x80-\\xff][A-Za-z0-9_$\\x80-\\xff]*/\n";
let _END_OF_FILE;
_END_OF_FILE = "\n\u0004";
let _PAIRS;
_PAIRS = new py.Dict([["(", ")"], ["[", "]"], ["{", "}"]]);
class Number {
constructor(value = null, start = null, end = null, text = null) {
this.value = value;
this.start = start;
this.end = end;
this.text = text;
}
get decimals() {
return py.len(py.at(py.call(py.at(py.call(py.call(this.text, "lower"), "partition", "e"), 0), "partition", "."), 2));
return null;
}
}
class Brackets {
constructor(kind = null, items = null, start_pos = null, end_pos = null) {
this.kind = kind;
this.items = items;
this.start_pos = start_pos;
this.end_pos = end_pos;
}
get parts() {
return split(this.items);
return null;
}
}
Brackets.prototype.type = "BRACKETS";
py.cached(Brackets.prototype, "parts");
class Statement {
constructor(items = null, start = null, end = null, line = null) {
this.items = items;
this.start = start;
this.end = end;
this.line = line;
}
}
function nested(tokens, over_lines = false) {
return py.add(py.call(_NESTED, "replace", "_inner: _item", (py.truth(over_lines) ? "_inner: _item | _END" : "_inner: _item")), tokens);
return null;
}
function place_of(items) {
return [py.at(items, 0).start_pos, py.at(items, -1).end_pos];
return null;
}
function split(items, sign = ",") {
let item, parts;
parts = [[]];
for (const $each of py.iter(items)) {
item = $each;
if (py.truth(py.both(py.same(item.type, "SIGN"), () => py.same(item, sign)))) {
py.call(parts, "append", []);
} else {
py.call(py.at(parts, -1), "append", item);
}
}
return (() => { const $out = []; for (const part of py.iter(parts)) { $out.push(py.tuple(part)); } return $out; })();
return null;
}
function number_of(items) {
let number, sign, start, value;
if (py.truth(py.both(py.same(py.len(items), 2), () => py.both(is_token(py.at(items, 0), "SIGN", "+", "-"), () => py.same(py.at(items, 0).end_pos, py.at(items, 1).start_pos))))) {
sign = py.str(py.at(items, 0));
number = py.at(items, 1);
} else {
if (py.same(py.len(items), 1)) {
sign = "";
number = py.at(items, 0);
} else {
return null;
}
}
if (!py.truth(is_token(number, "NUMBER"))) {
return null;
}
value = py.float(py.add(sign, py.str(number)));
start = py.at(items, 0).start_pos;
return (py.truth(math.isfinite(value)) ? new Number(value, start, number.end_pos, py.add(sign, py.str(number))) : null);
return null;
}
function number_at(token) {
let text;
text = py.str(token);
try {
return new Number(py.float(text), py.either(token.start_pos, () => 0), py.either(token.end_pos, () => 0), text);
} catch ($error) { if (!($error instanceof py.ValueError)) throw $error;
return null;
}
return null;
}
function numbers_of(parts) {
let found;
found = (() => { const $out = []; for (const part of py.iter(parts)) { $out.push(number_of(part)); } return $out; })();
return (!py.has(found, null) ? py.tuple((() => { const $out = []; for (const number of py.iter(found)) { if (((number) ?? null) !== (null)) $out.push(number); } return $out; })()) : null);
return null;
}
function aggregate(items, kind) {
return (py.truth(py.both(py.same(py.len(items), 1), () => py.both(py.isinstance(py.at(items, 0), [Brackets]), () => py.same(py.at(items, 0).kind, kind)))) ? py.at(items, 0) : null);
return null;
}
function call_of(items) {
if (py.truth(py.both(py.same(py.len(items), 2), () => py.both(is_token(py.at(items, 0), "WORD"), () => py.both(py.isinstance(py.at(items, 1), [Brackets]), () => py.same(py.at(items, 1).kind, "(")))))) {
return [py.str(py.at(items, 0)), py.at(items, 1)];
}
return null;
return null;
}
function is_token(item, kind, text = "", other = "") {
return py.both(py.bool(py.same(item.type, kind)), () => py.either(!py.truth(text), () => py.has([text, other], py.call(py.str(item), "upper"))));
return null;
}
function word(item) {
return (py.truth(is_token(item, "WORD")) ? py.call(py.str(item), "upper") : "");
return null;
}
function text_of_items(items, case_ = false) {
let found, item;
found = "";
for (const $each of py.iter(items)) {
item = $each;
if (py.truth(py.isinstance(item, [Brackets]))) {
found = py.add(found, py.add(py.add(item.kind, text_of_items(item.items, case_)), py.at(_PAIRS, item.kind)));
} else {
found = py.add(found, (py.truth(case_) ? py.str(item) : py.call(py.str(item), "upper")));
}
}
return found;
return null;
}
function element_name(items, case_ = false) {
let is_part, name, plain, rest;
if (py.truth(py.either(!py.truth(items), () => !py.truth(is_token(py.at(items, 0), "WORD"))))) {
return ["", false];
}
name = (py.truth(case_) ? py.str(py.at(items, 0)) : py.call(py.str(py.at(items, 0)), "upper"));
rest = py.text(items).slice(1, undefined);
if (py.truth(py.both(rest, () => py.both(py.isinstance(py.at(rest, 0), [Brackets]), () => py.has("[{", py.at(rest, 0).kind))))) {
plain = py.all((() => { const $out = []; for (const part of py.iter(py.at(rest, 0).parts)) { $out.push(py.both(py.same(py.len(part), 1), () => is_token(py.at(part, 0), "NUMBER"))); } return $out; })());
name = (py.str(name) + "[" + py.str((py.truth(plain) ? text_of_items(py.at(rest, 0).items) : "*")) + "]");
rest = py.text(rest).slice(1, undefined);
}
is_part = py.both(py.bool(rest), () => py.either(is_token(py.at(rest, 0), "SIGN", "."), () => py.isinstance(py.at(rest, 0), [Brackets])));
return (py.truth(py.either(!py.truth(rest), () => is_part)) ? [name, is_part] : ["", false]);
return null;
}
function* calls_in(items) {
let item, k;
for (const $each of py.iter(py.enumerate(items))) {
[k, item] = $each;
if (py.truth(py.isinstance(item, [Brackets]))) {
if (py.truth(py.both(py.same(item.kind, "("), () => py.both(k, () => is_token(py.at(items, py.sub(k, 1)), "WORD"))))) {
(yield [py.str(py.at(items, py.sub(k, 1))), item]);
}
(yield* py.iter(calls_in(item.items)));
}
}
}
function* words_in(items, case_ = false) {
let is_index, item, k, part;
for (const $each of py.iter(py.enumerate(items))) {
[k, item] = $each;
is_index = py.both((k > 0), () => py.same(py.at(items, py.sub(k, 1)).type, "WORD"));
if (py.truth(py.isinstance(item, [Brackets]))) {
for (const $each of py.iter(item.parts)) {
part = $each;
(yield* py.iter(words_in((py.truth(py.both(py.same(item.kind, "{"), () => !py.truth(is_index))) ? py.text(part).slice(1, undefined) : part), case_)));
}
} else {
if (py.same(item.type, "WORD")) {
(yield (py.truth(case_) ? py.str(item) : py.call(py.str(item), "upper")));
if (py.truth(py.both((py.add(k, 1) < py.len(items)), () => py.both(py.isinstance(py.at(items, py.add(k, 1)), [Brackets]), () => py.has("[{", py.at(items, py.add(k, 1)).kind))))) {
(yield py.at(element_name(py.text(items).slice(k, py.add(k, 2)), case_), 0));
}
}
}
}
}
return { LARGEST_PROGRAM, MOST_WORDS, DEEPEST, _NESTED, _END_OF_FILE, _PAIRS, Number, Brackets, Statement, nested, place_of, split, number_of, number_at, numbers_of, aggregate, call_of, is_token, word, text_of_items, element_name, calls_in, words_in };
})();
MODULES.understood = (() => {
class Understood {
constructor(kind = null, source = null, words = null) {
this.kind = kind;
this.source = source;
this.words = words;
}
}
let _PAIRS;
_PAIRS = new py.Dict([["(", ")"], ["[", "]"]]);
function understood_words(tables, kind) {
return py.frozenset((() => { const $out = []; for (const table of py.iter(tables)) { if (py.same(table.kind, kind)) for (const word of py.iter(py.call(table.words, "split", ","))) { $out.push(py.call(word, "strip")); } } return $out; })());
return null;
}
function without_brackets(text, quotes = true) {
let found, inner, is_quoted, letter, opened;
found = "";
opened = py.list();
is_quoted = false;
for (const $each of py.iter(py.call(text, "upper"))) {
letter = $each;
inner = (py.truth(opened) ? py.at(opened, -1) : "");
if (py.same(letter, py.call(_PAIRS, "get", inner, ""))) {
py.call(opened, "pop");
}
if (py.truth(py.both(quotes, () => py.both(py.same(letter, "'"), () => !py.truth(opened))))) {
is_quoted = !py.truth(is_quoted);
} else {
if (py.truth(py.both(!py.truth(opened), () => !py.truth(is_quoted)))) {
found = py.add(found, letter);
}
}
if (py.truth(py.either(py.same(letter, "["), () => py.both(py.same(letter, "("), () => !py.same(inner, "["))))) {
py.call(opened, "append", letter);
}
}
return found;
return null;
}
function tokens_of(text) {
let sign;
for (const $each of py.iter(["[]", "()", ",", ";", "="])) {
sign = $each;
text = py.call(text, "replace", sign, " ");
}
return (() => { const $out = []; for (const token of py.iter(py.call(text, "split"))) { $out.push(py.call(token, "strip", "0123456789.+-#%")); } return $out; })();
return null;
}
function first_phrase(tokens, known) {
let count, phrase;
for (const $each of py.iter([3, 2])) {
count = $each;
phrase = py.call(" ", "join", py.text(tokens).slice(undefined, count));
if (py.truth(py.both((py.len(tokens) >= count), () => py.has(known, phrase)))) {
return phrase;
}
}
return (py.truth(tokens) ? py.at(tokens, 0) : "");
return null;
}
function not_understood(text) {
return (py.repr(py.call(py.text(text).slice(undefined, 40), "strip")) + ", which is not understood and may displace positions");
return null;
}
return { Understood, _PAIRS, understood_words, without_brackets, tokens_of, first_phrase, not_understood };
})();
MODULES.flow = (() => {
const { Statement, word } = MODULES.syntax;
let _ROUNDS;
_ROUNDS = 8;
let _DEEPEST;
_DEEPEST = 100;
let OUTSIDE;
OUTSIDE = "is not in these files and may set it";
class Step {
constructor(opens = "", closes = [], routine = "", is_loop = false, is_jump = false, is_label = false, sets = py.frozenset(), clears = py.frozenset(), calls = [], starts = []) {
this.opens = opens;
this.closes = closes;
this.routine = routine;
this.is_loop = is_loop;
this.is_jump = is_jump;
this.is_label = is_label;
this.sets = sets;
this.clears = clears;
this.calls = calls;
this.starts = starts;
}
}
class InForce {
constructor(setters = null, blocks = null, run = null, routine = null) {
this.setters = setters;
this.blocks = blocks;
this.run = run;
this.routine = routine;
}
get depth() {
return py.len(this.blocks);
return null;
}
}
class Code {
constructor(source = null, statements = null, steps = null, flow = []) {
this.source = source;
this.statements = statements;
this.steps = steps;
this.flow = flow;
}
routine(k) {
let opening;
opening = py.at(this.flow, k).routine;
return ((opening >= 0) ? py.at(this.steps, opening).routine : "");
return null;
}
}
function followed(files, outside = py.frozenset(), ends = null) {
let around, at_any_time, blocks, code, effects, ended, found, jumps, known, paired, walk;
blocks = (() => { const $out = []; for (const code of py.iter(files)) { $out.push(_blocks(code)); } return $out; })();
paired = (() => { const $out = []; for (const [code, around] of py.iter(py.zip(files, blocks))) { $out.push([code.steps, around]); } return $out; })();
effects = _effects(paired, new py.Dict([]));
at_any_time = _at_any_time(files, effects, outside);
function walked(effects) {
let around, code, found, jumps, known, walk;
found = [];
for (const $each of py.iter(py.zip(files, blocks))) {
[code, around] = $each;
jumps = py.any((() => { const $out = []; for (const step of py.iter(code.steps)) { $out.push(step.is_label); } return $out; })());
known = [effects, outside, at_any_time];
walk = new _Walk(code.statements, code.steps, around, ...py.iter(known), (py.truth(jumps) ? null : ends));
py.call(found, "append", new Code(code.source, code.statements, code.steps, walk.through()));
}
return found;
return null;
}
found = walked(effects);
ended = (((ends) ?? null) !== (null) ? _ended(found, ends, effects) : new py.Dict([]));
return (py.truth(py.any(py.call(ended, "values"))) ? walked(_effects(paired, ended)) : found);
return null;
}
function _at_any_time(files, effects, outside) {
let code, found, name, statement, step, why;
found = new py.Dict([]);
for (const $each of py.iter(files)) {
code = $each;
for (const $each of py.iter(py.zip(code.statements, code.steps))) {
[statement, step] = $each;
for (const $each of py.iter(step.starts)) {
name = $each;
why = (py.str(name) + ", which line " + py.str(statement.line) + " starts, may set it at any time");
if (!py.has(effects, name)) {
why = ("line " + py.str(statement.line) + " starts " + py.str(name) + ", which " + py.str(OUTSIDE));
}
found = py.or(found, py.fromkeys(py.call(effects, "get", name, outside), why));
}
}
}
return found;
return null;
}
function leaves(statement) {
return py.has(["RETURN", "EXITCYCLE"], word(py.at(statement.items, 0)));
return null;
}
function _ended(files, ends, effects) {
let clean, code, found, is_end, k, name, routine, state, step;
found = py.dict();
for (const $each of py.iter(files)) {
code = $each;
for (const $each of py.iter(py.enumerate(code.steps))) {
[k, step] = $each;
is_end = py.both(py.bool(step.closes), () => py.bool(py.at(code.steps, py.at(py.at(code.flow, k).blocks, -1)).routine));
if (!py.truth(py.either(is_end, () => leaves(py.at(code.statements, k))))) {
continue;
}
routine = code.routine(k);
clean = py.set();
for (const $each of py.iter(py.call(effects, "get", routine, []))) {
name = $each;
state = py.call(py.at(code.flow, k).setters, "get", name);
if (py.truth(py.either(((state) ?? null) === (null), () => py.both(py.isinstance(state, ["int"]), () => ends(py.at(code.statements, state)))))) {
py.call(clean, "add", name);
}
}
py.put(found, routine, new Set((() => { const $out = []; for (const name of py.iter(clean)) { if (py.has(py.call(found, "get", routine, clean), name)) $out.push(name); } return $out; })()));
}
}
return found;
return null;
}
class _Walk {
constructor(statements = null, steps = null, blocks = null, effects = null, outside = null, at_any_time = null, ends = null, unbalanced = py.dict(), entered = py.dict(), state = py.dict(), saved = py.list(), run = 0) {
this.statements = statements;
this.steps = steps;
this.blocks = blocks;
this.effects = effects;
this.outside = outside;
this.at_any_time = at_any_time;
this.ends = ends;
this.unbalanced = unbalanced;
this.entered = entered;
this.state = state;
this.saved = saved;
this.run = run;
}
through() {
let _, count, inside, known;
inside = this._set_inside();
for (const $each of py.iter(py.range(_ROUNDS))) {
_ = $each;
count = py.len(this.unbalanced);
known = this._once_through(inside);
if (py.same(py.len(this.unbalanced), count)) {
return known;
}
}
this.ends = null;
return this._once_through(inside);
return null;
}
_once_through(inside) {
let i, known, routine, setters, step;
known = [];
this.state = new py.Dict([]);
this.run = 0;
for (const $each of py.iter(py.enumerate(this.steps))) {
[i, step] = $each;
if (py.truth(step.routine)) {
py.call(this.saved, "append", this.state);
this.state = new py.Dict([]);
}
this._join(i, inside);
this.run = py.add(this.run, py.bool(py.either(step.opens, () => py.either(step.closes, () => step.is_jump))));
routine = (py.truth(step.routine) ? i : _routine(this.steps, py.at(this.blocks, i)));
setters = (py.truth(this.at_any_time) ? new py.Dict([...py.iter(py.call(this.state, 'items')), ...py.iter(py.call(this.at_any_time, 'items'))]) : this.state);
py.call(known, "append", new InForce(setters, py.at(this.blocks, i), this.run, routine));
this._execute(i);
if (py.truth(py.either(step.opens, () => py.both(step.is_jump, () => py.both(step.calls, () => py.at(this.blocks, i)))))) {
py.put(this.entered, (py.truth(step.opens) ? i : py.at(py.at(this.blocks, i), -1)), this.state);
}
if (py.truth(this._ends_routine(i))) {
this.state = py.call(this.saved, "pop");
}
}
return known;
return null;
}
_set_inside() {
let around, block, called, changed, i, inside, step;
inside = new py.Dict((() => { const $out = []; for (const [i, step] of py.iter(py.enumerate(this.steps))) { if (py.truth(step.opens)) $out.push([i, py.set()]); } return $out; })());
for (const $each of py.iter(py.enumerate(this.steps))) {
[i, step] = $each;
called = (() => { const $out = []; for (const name of py.iter(step.calls)) { $out.push(py.call(this.effects, "get", name, this.outside)); } return $out; })();
changed = py.call(step.sets, "union", step.clears, ...py.iter(called));
if (!py.truth(changed)) {
continue;
}
around = (py.truth(step.closes) ? py.text(py.at(this.blocks, i)).slice(undefined, -1) : py.at(this.blocks, i));
for (const $each of py.iter([...py.iter(around), ...py.iter((py.truth(step.opens) ? [i] : []))])) {
block = $each;
py.put(inside, block, py.or(py.at(inside, block), changed));
}
}
return inside;
return null;
}
_ends_routine(i) {
return py.both(py.bool(py.at(this.steps, i).closes), () => py.bool(py.at(this.steps, py.at(py.at(this.blocks, i), -1)).routine));
return null;
}
_join(i, inside) {
let before, block, changed, kept, line, names, reason, same, step;
step = py.at(this.steps, i);
if (py.truth(py.either(py.both(step.closes, () => !py.truth(this._ends_routine(i))), () => step.is_jump))) {
block = (py.truth(py.at(this.blocks, i)) ? py.at(py.at(this.blocks, i), -1) : i);
line = py.at(this.statements, block).line;
names = py.call(inside, "get", block, py.set());
this._check_balance(block, names);
same = new Set((() => { const $out = []; for (const name of py.iter(names)) { if (py.truth(this._is_balanced(block, name))) $out.push(name); } return $out; })());
reason = ("it is set on some paths only through the block of line " + py.str(line));
this._forget(py.sub(names, same), reason);
if (py.truth(same)) {
before = py.call(py.at(this.entered, block), "items");
kept = new py.Dict((() => { const $out = []; for (const [name, found] of py.iter(py.call(this.state, "items"))) { if (!py.has(same, name)) $out.push([name, found]); } return $out; })());
this.state = py.or(kept, new py.Dict((() => { const $out = []; for (const [name, found] of py.iter(before)) { if (py.has(same, name)) $out.push([name, found]); } return $out; })()));
}
}
if (py.truth(step.is_loop)) {
line = py.at(this.statements, i).line;
py.put(this.entered, i, this.state);
changed = new Set((() => { const $out = []; for (const name of py.iter(py.at(inside, i))) { if (!py.truth(this._is_balanced(i, name))) $out.push(name); } return $out; })());
this._forget(changed, ("it is set within the loop of line " + py.str(line)));
}
if (py.has(["BREAK", "CONTINUE"], word(py.at(py.at(this.statements, i).items, 0)))) {
for (const $each of py.iter(py.at(this.blocks, i))) {
block = $each;
this._check_balance(block, py.at(inside, block));
}
}
return null;
}
_check_balance(block, names) {
let name;
for (const $each of py.iter(names)) {
name = $each;
if (!py.truth(this._is_off(this.state, name))) {
py.put(this.unbalanced, [block, name], true);
}
}
return null;
}
_is_balanced(block, name) {
if (py.truth(py.either(((this.ends) ?? null) === (null), () => py.either(py.at(this.steps, block).routine, () => py.has(this.unbalanced, [block, name]))))) {
return false;
}
return this._is_off(py.call(this.entered, "get", block, new py.Dict([])), name);
return null;
}
_is_off(state, name) {
let found;
found = py.call(state, "get", name);
if (!py.truth(py.isinstance(found, ["int"]))) {
return ((found) ?? null) === (null);
}
return py.both(((this.ends) ?? null) !== (null), () => this.ends(py.at(this.statements, found)));
return null;
}
_execute(i) {
let line, name, step, why;
step = py.at(this.steps, i);
line = py.at(this.statements, i).line;
for (const $each of py.iter(step.calls)) {
name = $each;
why = ("line " + py.str(line) + " calls " + py.str(name) + ", which ");
why = py.add(why, (py.has(this.effects, name) ? "sets it" : OUTSIDE));
this._forget(py.call(this.effects, "get", name, this.outside), why);
}
this._forget(step.clears, ("line " + py.str(line) + " may set it"));
if (py.truth(step.sets)) {
this.state = py.or(this.state, py.fromkeys(step.sets, i));
}
return null;
}
_forget(names, reason) {
if (py.truth(names)) {
this.state = py.or(this.state, py.fromkeys(names, reason));
}
return null;
}
}
function _routine(steps, blocks) {
return py.next((() => { const $out = []; for (const i of py.iter(py.reversed(blocks))) { if (py.truth(py.at(steps, i).routine)) $out.push(i); } return $out; })(), -1);
return null;
}
function _effects(files, ended) {
let ahead, blocks, called, callers, calls, changed, i, k, name, other, own, size, step, steps;
own = py.dict();
calls = py.dict();
for (const $each of py.iter(files)) {
[steps, blocks] = $each;
for (const $each of py.iter(py.enumerate(steps))) {
[k, step] = $each;
i = (py.truth(step.routine) ? k : _routine(steps, (py.truth(step.closes) ? py.text(py.at(blocks, k)).slice(undefined, -1) : py.at(blocks, k))));
if ((i >= 0)) {
name = py.at(steps, i).routine;
py.put(own, name, py.or(py.or(py.call(own, "get", name, py.set()), step.sets), step.clears));
py.put(calls, name, py.or(py.call(calls, "get", name, py.set()), py.set(step.calls)));
}
}
}
own = new py.Dict((() => { const $out = []; for (const [name, found] of py.iter(py.call(own, "items"))) { $out.push([name, py.sub(found, py.call(ended, "get", name, py.set()))]); } return $out; })());
callers = py.dict();
for (const $each of py.iter(py.call(calls, "items"))) {
[name, called] = $each;
for (const $each of py.iter(called)) {
other = $each;
py.call(py.call(callers, "setdefault", other, []), "append", name);
}
}
ahead = py.list(own);
while (py.truth(ahead)) {
changed = py.call(ahead, "pop");
for (const $each of py.iter(py.call(callers, "get", changed, []))) {
name = $each;
size = py.len(py.at(own, name));
py.put(own, name, py.or(py.at(own, name), py.sub(py.at(own, changed), py.call(ended, "get", name, py.set()))));
if ((py.len(py.at(own, name)) > size)) {
py.call(ahead, "append", name);
}
}
}
return new py.Dict((() => { const $out = []; for (const [name, found] of py.iter(py.call(own, "items"))) { $out.push([name, py.frozenset(found)]); } return $out; })());
return null;
}
function _blocks(code) {
let blocks, found, i, line, opens, step;
found = [];
blocks = [];
for (const $each of py.iter(py.enumerate(code.steps))) {
[i, step] = $each;
py.call(found, "append", blocks);
if (py.truth(step.closes)) {
_check_closing(code, i, blocks);
blocks = py.text(blocks).slice(undefined, -1);
}
if (py.truth(step.opens)) {
blocks = [...py.iter(blocks), i];
if ((py.len(blocks) > _DEEPEST)) {
throw code.source.error(("a block within " + py.str(_DEEPEST) + " others; expected fewer"), py.at(code.statements, i).start);
}
}
}
if (py.truth(blocks)) {
opens = py.at(code.steps, py.at(blocks, -1)).opens;
line = py.at(code.statements, py.at(blocks, -1)).line;
throw code.source.error(("the end of the file within " + py.str(opens) + " of line " + py.str(line) + ": is it truncated?"), py.len(code.source.content));
}
return found;
return null;
}
function _check_closing(code, i, blocks) {
let closes, line, opened, opens, start, word;
closes = py.at(code.steps, i).closes;
start = py.at(code.statements, i).start;
word = py.str(py.at(py.at(code.statements, i).items, 0));
if (!py.truth(blocks)) {
opened = py.call(" or ", "join", closes);
throw code.source.error((py.repr(word) + " has nothing to close; expected " + py.str(opened) + " before it"), start);
}
opens = py.at(code.steps, py.at(blocks, -1)).opens;
if (!py.has(closes, opens)) {
line = py.at(code.statements, py.at(blocks, -1)).line;
throw code.source.error((py.repr(word) + " within " + py.str(opens) + " of line " + py.str(line) + "; expected its end first"), start);
}
return null;
}
return { _ROUNDS, _DEEPEST, OUTSIDE, Step, InForce, Code, followed, _at_any_time, leaves, _ended, _Walk, _routine, _effects, _blocks, _check_closing };
})();
MODULES.line_flow = (() => {
const { OUTSIDE } = MODULES.flow;
let MOST_STATES;
MOST_STATES = 3000000;
let ANY;
ANY = "*";
let STATED_LOAD;
STATED_LOAD = "load";
let POSITIONS;
POSITIONS = "positions";
class Line {
constructor(number = null, sets = [], ends = [], label = "", jumps = [], calls = [], is_last = false, block = "") {
this.number = number;
this.sets = sets;
this.ends = ends;
this.label = label;
this.jumps = jumps;
this.calls = calls;
this.is_last = is_last;
this.block = block;
}
}
class Listing {
constructor(name = null, lines = null) {
this.name = name;
this.lines = lines;
}
}
function with_outside(listings, switched) {
let found, in_play, known, line, lines, listing, more, outside, used, why;
known = new Set((() => { const $out = []; for (const listing of py.iter(listings)) { $out.push(listing.name); } return $out; })());
used = py.set();
for (const $each of py.iter(listings)) {
listing = $each;
for (const $each of py.iter(listing.lines)) {
line = $each;
used = py.or(used, new Set([...py.iter(line.ends), ...py.iter((() => { const $out = []; for (const [name, ] of py.iter(line.sets)) { $out.push(name); } return $out; })())]));
}
}
in_play = (() => { const $out = []; for (const name of py.iter(switched)) { if (py.has(used, name)) $out.push(name); } return $out; })();
found = [];
for (const $each of py.iter(listings)) {
listing = $each;
lines = [];
for (const $each of py.iter(listing.lines)) {
line = $each;
outside = (() => { const $out = []; for (const name of py.iter(line.calls)) { if (!py.has(known, name)) $out.push(name); } return $out; })();
why = (py.truth(outside) ? ("line " + py.str(line.number) + " calls " + py.str(py.at(outside, 0)) + ", which " + py.str(OUTSIDE)) : "");
more = (py.truth(outside) ? (() => { const $out = []; for (const name of py.iter(in_play)) { $out.push([name, why]); } return $out; })() : []);
py.call(lines, "append", py.replace(line, { sets: [...py.iter(line.sets), ...py.iter(more)] }));
}
py.call(found, "append", new Listing(listing.name, lines));
}
return found;
return null;
}
function reasons_before(listings, lasting = []) {
let count, listing, paths, start, switched;
switched = new Set((() => { const $out = []; for (const listing of py.iter(listings)) { for (const line of py.iter(listing.lines)) { for (const [name, ] of py.iter(line.sets)) { $out.push(name); } } } return $out; })());
count = py.sum((() => { const $out = []; for (const listing of py.iter(listings)) { $out.push(py.len(listing.lines)); } return $out; })());
if (((py.len(switched) * count) > MOST_STATES)) {
throw new ProgramError((py.str(py.len(switched)) + " frames that change on " + py.str(count) + " lines; expected a program of at most " + py.str(MOST_STATES) + " pairs of these: divide it"));
}
paths = new _Paths(listings, lasting);
for (const $each of py.iter(listings)) {
listing = $each;
py.call(paths.starts, "append", py.len(paths.lines));
paths.lines = py.add(paths.lines, listing.lines);
paths.next = py.add(paths.next, (() => { const $out = []; for (const _ of py.iter(listing.lines)) { $out.push([]); } return $out; })());
if (py.truth(listing.lines)) {
py.put(paths.entries, listing.name, py.at(paths.starts, -1));
}
}
for (const $each of py.iter(py.zip(listings, paths.starts))) {
[listing, start] = $each;
paths.connect(start, listing.lines);
}
return paths.reasons();
return null;
}
class _Paths {
constructor(listings = null, lasting = null, starts = py.list(), lines = py.list(), next = py.list(), again = py.dict(), entries = py.dict()) {
this.listings = listings;
this.lasting = lasting;
this.starts = starts;
this.lines = lines;
this.next = next;
this.again = again;
this.entries = entries;
}
connect(start, lines) {
let is_end, k, labels, line;
this._connect_blocks(start, lines);
labels = this._labels(start, lines);
for (const $each of py.iter(py.enumerate(lines))) {
[k, line] = $each;
is_end = py.same(py.add(k, 1), py.len(lines));
if (py.truth(is_end)) {
py.put(this.again, py.add(start, k), start);
} else {
if (py.truth(py.both(!py.truth(py.both(line.is_last, () => py.at(lines, py.add(k, 1)).label)), () => !py.same(py.at(lines, py.add(k, 1)).block, "else")))) {
py.call(py.at(this.next, py.add(start, k)), "append", py.add(py.add(start, k), 1));
}
}
py.put(this.next, py.add(start, k), py.add(py.at(this.next, py.add(start, k)), (() => { const $out = []; for (const label of py.iter(line.jumps)) { if (py.has(labels, label)) $out.push(py.at(labels, label)); } return $out; })()));
}
return null;
}
_labels(start, lines) {
let found, k, label, line, places, those;
places = py.dict();
for (const $each of py.iter(py.enumerate(lines))) {
[k, line] = $each;
if (py.truth(line.label)) {
py.call(py.call(places, "setdefault", line.label, []), "append", py.add(start, k));
py.call(py.call(places, "setdefault", ANY, []), "append", py.add(start, k));
}
}
found = py.dict();
for (const $each of py.iter(py.call(places, "items"))) {
[label, those] = $each;
py.put(found, label, py.at(those, 0));
if ((py.len(those) > 1)) {
py.put(found, label, py.len(this.lines));
py.call(this.lines, "append", new Line(0));
py.call(this.next, "append", those);
}
}
return found;
return null;
}
_connect_blocks(start, lines) {
let first, k, line, opened, tail, tails;
opened = py.list();
tails = py.list();
for (const $each of py.iter(py.enumerate(lines))) {
[k, line] = $each;
if (py.has(["loop", "branch"], line.block)) {
py.call(opened, "append", k);
py.call(tails, "append", [k]);
} else {
if (py.same(line.block, "else")) {
if (py.truth(opened)) {
py.call(py.at(tails, -1), "append", py.sub(k, 1));
py.call(py.at(this.next, py.add(start, py.at(opened, -1))), "append", py.add(start, k));
} else {
if ((k > 0)) {
py.call(py.at(this.next, py.sub(py.add(start, k), 1)), "append", py.add(start, k));
}
}
} else {
if (py.truth(py.both(py.same(line.block, "end"), () => opened))) {
first = py.call(opened, "pop");
for (const $each of py.iter(py.call(tails, "pop"))) {
tail = $each;
py.call(py.at(this.next, py.add(start, tail)), "append", py.add(start, k));
}
if (py.same(py.at(lines, first).block, "loop")) {
py.call(py.at(this.next, py.add(start, k)), "append", py.add(start, first));
}
}
}
}
}
return null;
}
_effects_of_calls() {
let ahead, caller, callers, effects, line, listing, name, reason, size, variable;
effects = new py.Dict((() => { const $out = []; for (const listing of py.iter(this.listings)) { $out.push([listing.name, py.dict()]); } return $out; })());
callers = py.dict();
for (const $each of py.iter(this.listings)) {
listing = $each;
for (const $each of py.iter(listing.lines)) {
line = $each;
for (const $each of py.iter(line.sets)) {
[variable, reason] = $each;
py.call(py.at(effects, listing.name), "setdefault", variable, reason);
}
for (const $each of py.iter(line.calls)) {
name = $each;
py.put(py.call(callers, "setdefault", name, new py.Dict([])), listing.name, true);
}
}
}
ahead = (() => { const $out = []; for (const listing of py.iter(this.listings)) { $out.push(listing.name); } return $out; })();
while (py.truth(ahead)) {
name = py.call(ahead, "pop");
for (const $each of py.iter(py.call(callers, "get", name, new py.Dict([])))) {
caller = $each;
size = py.len(py.at(effects, caller));
for (const $each of py.iter(py.list(py.call(py.at(effects, name), "items")))) {
[variable, reason] = $each;
py.call(py.at(effects, caller), "setdefault", variable, reason);
}
if ((py.len(py.at(effects, caller)) > size)) {
py.call(ahead, "append", caller);
}
}
}
return effects;
return null;
}
reasons() {
let after, ahead, before, called, called_here, is_ahead, j, k, lasts, state, targets;
before = (() => { const $out = []; for (const _ of py.iter(this.lines)) { $out.push(new py.Dict([])); } return $out; })();
called = this._effects_of_calls();
is_ahead = (() => { const $out = []; for (const _ of py.iter(this.lines)) { $out.push(true); } return $out; })();
ahead = py.list(py.reversed(py.range(py.len(this.lines))));
while (py.truth(ahead)) {
k = py.call(ahead, "pop");
py.put(is_ahead, k, false);
after = this._after(k, py.at(before, k), called);
lasts = new py.Dict((() => { const $out = []; for (const [name, reason] of py.iter(py.call(after, "items"))) { if (py.has(this.lasting, name)) $out.push([name, reason]); } return $out; })());
targets = (() => { const $out = []; for (const j of py.iter(py.at(this.next, k))) { $out.push([j, after]); } return $out; })();
called_here = (() => { const $out = []; for (const n of py.iter(py.at(this.lines, k).calls)) { if (py.has(this.entries, n)) $out.push(py.at(this.entries, n)); } return $out; })();
targets = py.add(targets, (() => { const $out = []; for (const entry of py.iter(called_here)) { $out.push([entry, py.at(before, k)]); } return $out; })());
if (py.has(this.again, k)) {
py.call(targets, "append", [py.at(this.again, k), lasts]);
}
for (const $each of py.iter(targets)) {
[j, state] = $each;
if (py.truth(py.all((() => { const $out = []; for (const name of py.iter(state)) { $out.push(py.has(py.at(before, j), name)); } return $out; })()))) {
continue;
}
py.put(before, j, (py.truth(py.at(before, j)) ? new py.Dict([...py.iter(py.call(state, 'items')), ...py.iter(py.call(py.at(before, j), 'items'))]) : py.dict(state)));
if (!py.truth(py.at(is_ahead, j))) {
py.put(is_ahead, j, true);
py.call(ahead, "append", j);
}
}
}
return (() => { const $out = []; for (const [listing, start] of py.iter(py.zip(this.listings, this.starts))) { $out.push(py.text(before).slice(start, py.add(start, py.len(listing.lines)))); } return $out; })();
return null;
}
_after(k, before, called) {
let after, line, name, new_;
line = py.at(this.lines, k);
after = before;
for (const $each of py.iter(line.calls)) {
name = $each;
new_ = py.call(called, "get", name, new py.Dict([]));
if (py.truth(new_)) {
after = new py.Dict([...py.iter(py.call(new_, 'items')), ...py.iter(py.call(after, 'items'))]);
}
}
if (py.truth(line.ends)) {
after = new py.Dict((() => { const $out = []; for (const [name, reason] of py.iter(py.call(after, "items"))) { if (!py.has(line.ends, name)) $out.push([name, reason]); } return $out; })());
}
if (py.truth(line.sets)) {
after = new py.Dict([...py.iter(py.call(after, 'items')), ...py.iter(py.call(new py.Dict((() => { const $out = []; for (const [name, reason] of py.iter(line.sets)) { $out.push([name, reason]); } return $out; })()), 'items'))]);
}
return after;
return null;
}
}
return { MOST_STATES, ANY, STATED_LOAD, POSITIONS, Line, Listing, with_outside, reasons_before, _Paths };
})();
MODULES.program = (() => {
const { Number, Statement } = MODULES.syntax;
class Turn {
constructor(joint = null, kind = null, value = null, number = null, bit = null) {
this.joint = joint;
this.kind = kind;
this.value = value;
this.number = number;
this.bit = bit;
}
counted(angle) {
if (py.same(this.kind, "negative")) {
return py.int((angle < 0.0));
}
if (py.same(this.kind, "half")) {
return py.int((py.abs(angle) >= math.pi));
}
return math.floor((py.same(this.kind, "quarter") ? (angle / (0.5 * math.pi)) : (py.add(angle, math.pi) / (2.0 * math.pi))));
return null;
}
}
class Posture {
constructor(front = null, up = null, down = null, turns = []) {
this.front = front;
this.up = up;
this.down = down;
this.turns = turns;
}
get sides() {
return [this.front, this.up, this.down];
return null;
}
get is_whole() {
return !py.has(this.sides, null);
return null;
}
allows(sides) {
let pairs;
pairs = py.zip(this.sides, sides);
return py.all((() => { const $out = []; for (const [wanted, side] of py.iter(pairs)) { $out.push(py.either(((wanted) ?? null) === (null), () => py.either(!py.truth(side), () => py.same((side > 0.0), wanted)))); } return $out; })());
return null;
}
}
class Frame {
constructor(name = null, pose = null, reason = "") {
this.name = name;
this.pose = pose;
this.reason = reason;
}
}
Frame.prototype.__hash__ = null;
class Point {
constructor(name = null, source = null, line = null, kind = null, numbers = null, posture = new Posture(), tool = null, base = null, near = null) {
this.name = name;
this.source = source;
this.line = line;
this.kind = kind;
this.numbers = numbers;
this.posture = posture;
this.tool = tool;
this.base = base;
this.near = near;
}
get key() {
return [this.source, py.at(this.numbers, 0).start];
return null;
}
skip(reason) {
return new Skipped(this.name, this.source, this.line, reason);
return null;
}
}
class Skipped {
constructor(name = null, source = null, line = null, reason = null) {
this.name = name;
this.source = source;
this.line = line;
this.reason = reason;
}
}
class Load {
constructor(text = null, line = null, mass = null) {
this.text = text;
this.line = line;
this.mass = mass;
}
}
class Motion {
constructor(path = null, targets = null, statement = null, source = null, tool = new Frame(""), base = new Frame(""), span = [0, 0], run = 0, can_insert = false, takes_posture = true, load = null, displaced = "") {
this.path = path;
this.targets = targets;
this.statement = statement;
this.source = source;
this.tool = tool;
this.base = base;
this.span = span;
this.run = run;
this.can_insert = can_insert;
this.takes_posture = takes_posture;
this.load = load;
this.displaced = displaced;
}
}
class Program {
constructor(sources = null, tools = null, bases = null, points = py.dict(), motions = py.list(), skipped = py.list(), loads = py.dict()) {
this.sources = sources;
this.tools = tools;
this.bases = bases;
this.points = points;
this.motions = motions;
this.skipped = skipped;
this.loads = loads;
}
leave(only_read) {
let key, point, used;
used = new Set((() => { const $out = []; for (const [motion, keys] of py.iter(this.motions)) { if (!py.has(only_read, motion.source)) for (const key of py.iter(keys)) { $out.push(key); } } return $out; })());
this.skipped = (() => { const $out = []; for (const one of py.iter(this.skipped)) { if (!py.has(only_read, one.source)) $out.push(one); } return $out; })();
for (const $each of py.iter((() => { const $out = []; for (const key of py.iter(this.points)) { if (py.has(only_read, py.at(key, 0))) $out.push(key); } return $out; })())) {
key = $each;
point = py.call(this.points, "pop", key);
if (py.has(used, key)) {
py.call(this.skipped, "append", point.skip("it is in a file that is only read"));
}
}
return null;
}
}
class Edit {
constructor(source = null, start = null, end = null, text = null) {
this.source = source;
this.start = start;
this.end = end;
this.text = text;
}
}
function counted_axes(count) {
return (py.str(count) + " " + py.str((py.same(count, 1) ? "axis" : "axes")));
return null;
}
function number_text(number, value, least) {
let digits, sign;
if ((py.abs(py.sub(value, number.value)) < (0.5 * (10.0 ** -least)))) {
return number.text;
}
digits = (py.format(py.add(py.round(value, py.max(number.decimals, least)), 0.0), ("." + py.str(py.max(number.decimals, least)) + "f")));
sign = (py.truth(py.both(py.call(number.text, "startswith", "+"), () => !py.truth(py.call(digits, "startswith", "-")))) ? "+" : "");
if (py.truth(py.both(py.call(py.call(number.text, "lstrip", "+-"), "startswith", "."), () => py.call(py.call(digits, "lstrip", "-"), "startswith", "0.")))) {
digits = py.call(digits, "replace", "0.", ".", 1);
}
return py.add(sign, digits);
return null;
}
return { Turn, Posture, Frame, Point, Skipped, Load, Motion, Program, Edit, counted_axes, number_text };
})();
MODULES.draft = (() => {
const { ANY, STATED_LOAD, Line } = MODULES.line_flow;
const { FrameKind, Motion, Point, PointKey, Program, Skipped } = MODULES.program;
const { Statement } = MODULES.syntax;
let MOST_USES;
MOST_USES = 1000000;
let EVERY;
EVERY = "*";
class Draft {
constructor(sources = null, by_itself = false, motions = py.list(), skipped = py.list(), constants = py.set(), near = py.dict(), at_rest = py.dict(), masses = py.dict(), _points = py.dict(), _frames = new py.Dict([["tool", new py.Dict([])], ["base", new py.Dict([])]]), _arrays = py.dict(), _framed = py.dict(), _written = py.dict(), _read = py.set(), _origins = py.dict()) {
this.sources = sources;
this.by_itself = by_itself;
this.motions = motions;
this.skipped = skipped;
this.constants = constants;
this.near = near;
this.at_rest = at_rest;
this.masses = masses;
this._points = _points;
this._frames = _frames;
this._arrays = _arrays;
this._framed = _framed;
this._written = _written;
this._read = _read;
this._origins = _origins;
}
declare(point) {
if (py.truth(py.both(!py.has(this._points, point.name), () => !py.same(point.name, _stem(point.name))))) {
py.call(py.call(this._arrays, "setdefault", _stem(point.name), []), "append", point.name);
}
py.call(py.call(this._points, "setdefault", point.name, []), "append", point);
return null;
}
take(found) {
if (py.truth(py.isinstance(found, [Skipped]))) {
py.call(this.skipped, "append", found);
this.write(found.name, found.reason);
} else {
this.declare(found);
}
return null;
}
frame(name, pose, kinds) {
let kind;
for (const $each of py.iter(kinds)) {
kind = $each;
py.put(py.at(this._frames, kind), name, (py.has(py.at(this._frames, kind), name) ? "it has more than one value" : pose));
}
return null;
}
write(name, reason) {
py.call(this._written, "setdefault", name, reason);
return null;
}
write_any(reason) {
this.write(EVERY, reason);
return null;
}
pass_to(routine, names, line) {
let name;
for (const $each of py.iter(names)) {
name = $each;
if (!py.has(this.constants, name)) {
this.write(name, ("line " + py.str(line) + " passes it to " + py.str(routine) + ", which may change it"));
}
}
return null;
}
read(names) {
this._read = py.or(this._read, py.set(names));
return null;
}
derive(name, origins) {
py.call(py.call(this._origins, "setdefault", name, py.set()), "update", origins);
this.read(origins);
return null;
}
names() {
return this._points;
return null;
}
why_displaced(name, reasons) {
let _, index, kind, reason, what;
for (const $each of py.iter(py.call(reasons, "items"))) {
[what, reason] = $each;
if (py.same(what, STATED_LOAD)) {
continue;
}
[kind, , index] = [...py.iter(py.call(what, "partition", " "))];
if (py.truth(py.either(!py.has(["tool", "base"], kind), () => py.both(!py.same(index, ANY), () => !py.truth(py.call(index, "isdigit")))))) {
return reason;
}
if (py.has(this._frames_of(name), what)) {
return (py.str(what) + ": " + py.str(reason));
}
}
return "";
return null;
}
_frames_of(name) {
let found, other, point;
if (!py.has(this._framed, name)) {
found = py.set();
for (const $each of py.iter(this.elements(name))) {
other = $each;
for (const $each of py.iter(py.at(this._points, other))) {
point = $each;
if (py.same(point.kind, "pose")) {
found = py.or(found, new Set([("tool " + py.str(ANY)), ("base " + py.str(ANY))]));
found = py.or(found, (((point.tool) ?? null) !== (null) ? new Set([("tool " + py.str(point.tool.name))]) : py.set()));
found = py.or(found, (((point.base) ?? null) !== (null) ? new Set([("base " + py.str(point.base.name))]) : py.set()));
}
}
}
py.put(this._framed, name, found);
}
return py.at(this._framed, name);
return null;
}
leave_unused(lines) {
let line, name, reason, reasons, used, why;
used = new Set((() => { const $out = []; for (const motion of py.iter(this.motions)) { for (const target of py.iter(motion.targets)) { if (py.truth(py.isinstance(target, ["str"]))) $out.push(target); } } return $out; })());
reasons = py.dict();
for (const $each of py.iter(lines)) {
line = $each;
for (const $each of py.iter(line.sets)) {
[name, reason] = $each;
py.call(reasons, "setdefault", name, reason);
}
}
for (const $each of py.iter(this._points)) {
name = $each;
why = (py.has(used, name) ? "" : this.why_displaced(name, reasons));
if (py.truth(why)) {
this.write(name, why);
}
}
return null;
}
finish() {
let frames, known, motion, program, uses;
frames = this._values_of_frames();
program = new Program(this.sources, py.at(frames, "tool"), py.at(frames, "base"), undefined, undefined, py.list(this.skipped));
known = this._known(program);
uses = new _Uses(this, program, known, new Set((() => { const $out = []; for (const one of py.iter(program.skipped)) { $out.push(one.name); } return $out; })()));
for (const $each of py.iter(this.motions)) {
motion = $each;
uses.follow(motion);
}
uses.add_unused();
program.skipped = py.add(program.skipped, (() => { const $out = []; for (const [key, reason] of py.iter(py.call(uses.ambiguous, "items"))) { $out.push(py.call(uses.used, "pop", key).skip(reason)); } return $out; })());
program.points = uses.used;
return program;
return null;
}
_values_of_frames() {
let frame, frames, is_followed, kind, motion, why;
frames = new py.Dict((() => { const $out = []; for (const [kind, found] of py.iter(py.call(this._frames, "items"))) { $out.push([kind, new py.Dict((() => { const $out = []; for (const [name, pose] of py.iter(py.call(found, "items"))) { $out.push([name, py.either(this.why_written(name), () => pose)]); } return $out; })())]); } return $out; })());
for (const $each of py.iter(this.motions)) {
motion = $each;
for (const $each of py.iter([["tool", motion.tool], ["base", motion.base]])) {
[kind, frame] = $each;
is_followed = py.either(((frame.pose) ?? null) !== (null), () => py.has(["", "$"], py.text(frame.name).slice(undefined, 1)));
why = (py.truth(is_followed) ? "" : this.why_written(frame.name));
if (py.truth(why)) {
py.call(py.at(frames, kind), "setdefault", frame.name, why);
}
}
}
return frames;
return null;
}
_known(program) {
let frames, known, name, named, points, reason, seed, targets;
known = new py.Dict([]);
frames = this._frame_names();
named = new Set((() => { const $out = []; for (const motion of py.iter(this.motions)) { for (const target of py.iter(motion.targets)) { if (py.truth(py.isinstance(target, ["str"]))) $out.push(target); } } return $out; })());
targets = new Set((() => { const $out = []; for (const target of py.iter(named)) { for (const name of py.iter(py.either(this.elements(target), () => [target]))) { $out.push(name); } } return $out; })());
for (const $each of py.iter(py.call(this._points, "items"))) {
[name, points] = $each;
if (py.truth(py.both(py.has(frames, name), () => !py.has(targets, name)))) {
continue;
}
reason = this.why_written(name);
if (py.has(frames, name)) {
reason = "it is a tool or a base, or one is computed from it";
} else {
if ((py.len(points) > 1)) {
reason = ("it has different values on lines " + py.str(py.at(points, 0).line) + " and " + py.str(py.at(points, 1).line));
}
}
if (py.truth(reason)) {
program.skipped = py.add(program.skipped, (() => { const $out = []; for (const point of py.iter(points)) { $out.push(point.skip(reason)); } return $out; })());
} else {
py.put(known, name, py.at(points, 0));
}
}
for (const $each of py.iter(py.call(this.near, "items"))) {
[name, seed] = $each;
if (py.truth(py.both(py.has(known, name), () => py.both(py.has(known, seed), () => py.same(py.at(known, seed).kind, "joints"))))) {
py.put(known, name, py.replace(py.at(known, name), { near: py.tuple(py.at(known, seed).values) }));
}
}
return known;
return null;
}
_frame_names() {
let ahead, found, more, name;
found = py.or(new Set((() => { const $out = []; for (const motion of py.iter(this.motions)) { for (const frame of py.iter([motion.tool, motion.base])) { $out.push(frame.name); } } return $out; })()), new Set(["$TOOL", "$BASE"]));
ahead = py.list(found);
while (py.truth(ahead)) {
name = py.call(ahead, "pop");
more = py.sub(py.call(py.set(), "union", ...py.iter((() => { const $out = []; for (const other of py.iter([name, _any(name)])) { $out.push(py.call(this._origins, "get", other, py.set())); } return $out; })())), found);
found = py.or(found, more);
ahead = py.add(ahead, more);
}
return found;
return null;
}
why_written(name) {
let names;
names = [name, _any(name), _stem(name)];
if (!py.truth(py.and(new Set([name, _stem(name)]), this.constants))) {
py.call(names, "append", EVERY);
}
return py.next((() => { const $out = []; for (const one of py.iter(names)) { if (py.has(this._written, one)) $out.push(py.at(this._written, one)); } return $out; })(), "");
return null;
}
elements(name) {
if (py.has(name, "*")) {
return py.call(this._arrays, "get", _stem(name), []);
}
return (py.has(this._points, name) ? [name] : []);
return null;
}
is_read(name) {
return py.either(py.has(this._read, name), () => py.has(this._read, _any(name)));
return null;
}
}
class _Uses {
constructor(draft = null, program = null, known = null, said = null, used = py.dict(), ambiguous = py.dict(), meant = py.dict(), loads = py.dict(), work = 0) {
this.draft = draft;
this.program = program;
this.known = known;
this.said = said;
this.used = used;
this.ambiguous = ambiguous;
this.meant = meant;
this.loads = loads;
this.work = work;
}
follow(motion) {
let at, place, point, points, stops, target;
stops = [];
for (const $each of py.iter(motion.targets)) {
target = $each;
points = this._points_of(target);
if (!py.truth(points)) {
this._leave(target, motion);
}
for (const $each of py.iter(points)) {
point = $each;
this._use(point, motion);
}
py.call(stops, "append", (py.same(py.len(points), 1) ? py.at(points, 0).key : null));
}
at = motion.statement;
place = new Statement([], at.start, at.end, at.line);
py.call(this.program.motions, "append", [py.replace(motion, { statement: place }), py.tuple(stops)]);
return null;
}
_points_of(target) {
let names;
if (!py.truth(py.isinstance(target, ["str"]))) {
return (py.truth(py.isinstance(target, [Point])) ? [target] : []);
}
if (!py.has(this.meant, target)) {
names = this.draft.elements(target);
py.put(this.meant, target, (() => { const $out = []; for (const name of py.iter(names)) { if (py.has(this.known, name)) $out.push(py.at(this.known, name)); } return $out; })());
}
this.work = py.add(this.work, py.len(py.at(this.meant, target)));
if ((this.work > MOST_USES)) {
throw new ProgramError(("more than " + py.str(MOST_USES) + " uses of points by motions, computed indices included; expected fewer: divide the program"));
}
return py.at(this.meant, target);
return null;
}
_leave(target, motion) {
let line, reason;
if (py.truth(py.isinstance(target, [Skipped]))) {
py.call(this.program.skipped, "append", target);
py.call(this.said, "add", target.name);
} else {
if (py.truth(py.both(py.isinstance(target, ["str"]), () => !py.truth(py.either(py.has(this.said, target), () => this.draft.elements(target)))))) {
reason = py.either(this.draft.why_written(target), () => "declared elsewhere");
line = motion.statement.line;
py.call(this.program.skipped, "append", new Skipped(target, motion.source, line, reason));
py.call(this.said, "add", target);
}
}
return null;
}
_use(point, motion) {
let before, framed;
this._note_load(point, motion);
framed = py.replace(point, { tool: py.either(point.tool, () => motion.tool), base: py.either(point.base, () => motion.base) });
before = py.call(this.used, "setdefault", point.key, framed);
if (py.same(point.kind, "joints")) {
if (py.truth(motion.displaced)) {
py.put(this.ambiguous, point.key, motion.displaced);
}
} else {
if (!py.same([before.tool, before.base], [framed.tool, framed.base])) {
py.put(this.ambiguous, point.key, ("used with different frames before and on line " + py.str(motion.statement.line)));
}
}
return null;
}
_note_load(point, motion) {
let found, line, name, text;
found = py.call(this.program.loads, "setdefault", point.key, []);
line = (((motion.load) ?? null) !== (null) ? motion.load.line : 0);
text = (((motion.load) ?? null) !== (null) ? motion.load.text : "");
name = [...py.iter(point.key), line, text];
if (!py.has(this.loads, name)) {
py.put(this.loads, name, true);
py.call(found, "append", motion.load);
}
return null;
}
add_unused() {
let point, reason;
for (const $each of py.iter(py.call(this.known, "values"))) {
point = $each;
if (py.has(this.used, point.key)) {
continue;
}
reason = this._why_unused(point);
if (py.truth(reason)) {
py.call(this.program.skipped, "append", point.skip(reason));
} else {
py.put(this.used, point.key, point);
}
}
return null;
}
_why_unused(point) {
let is_framed;
if (py.truth(this.draft.is_read(point.name))) {
return "other positions are computed from it, and no motion uses it directly";
}
is_framed = py.both(((point.tool) ?? null) !== (null), () => ((point.base) ?? null) !== (null));
if (py.truth(py.both(this.draft.by_itself, () => py.either(py.same(point.kind, "joints"), () => is_framed)))) {
return "";
}
if (py.same(point.kind, "joints")) {
return "no motion uses it here: it may be something else than a position";
}
return "no motion uses it here, so its tool and base are not known";
return null;
}
}
function joined(programs) {
let first, other;
first = py.at(programs, 0);
for (const $each of py.iter(py.text(programs).slice(1, undefined))) {
other = $each;
py.call(first.points, "update", other.points);
first.motions = py.add(first.motions, other.motions);
first.skipped = py.add(first.skipped, other.skipped);
py.call(first.loads, "update", other.loads);
}
return first;
return null;
}
function _stem(name) {
return py.at(py.call(py.at(py.call(name, "partition", "["), 0), "partition", "{"), 0);
return null;
}
function _any(name) {
return (py.str(_stem(name)) + "[*]");
return null;
}
return { MOST_USES, EVERY, Draft, _Uses, joined, _stem, _any };
})();
MODULES.statement_reader = (() => {
const { Draft } = MODULES.draft;
const { Code, InForce, Step, leaves } = MODULES.flow;
const { STATED_LOAD } = MODULES.line_flow;
const { Frame, Load, Point, Skipped } = MODULES.program;
const { Brackets, Statement, calls_in, element_name, split, text_of_items, words_in } = MODULES.syntax;
let PARAMETER;
PARAMETER = "a parameter of the routine";
let EXTERNAL;
EXTERNAL = "an external axis is not at 0";
class Reader {
constructor(draft = null, file = null, code = null, harmless = null, entries = null) {
this.draft = draft;
this.file = file;
this.code = code;
this.harmless = harmless;
this.entries = entries;
}
get statements() {
return this.code.statements;
return null;
}
get steps() {
return this.code.steps;
return null;
}
get flow() {
return this.code.flow;
return null;
}
literal(line, name, items) {
throw NotImplementedError;
return null;
}
skip(name, line, reason) {
return new Skipped(name, this.file, line, reason);
return null;
}
not_understood(motion, line) {
py.call(this.draft.skipped, "append", this.skip((py.str(motion) + " of line " + py.str(line)), line, "not understood"));
return null;
}
words(items) {
return py.set(words_in(items, this.case));
return null;
}
parameters(k) {
return py.call(this._parameters, "get", py.at(this.flow, k).routine, py.frozenset());
return null;
}
get _parameters() {
return new py.Dict((() => { const $out = []; for (const [k, step] of py.iter(py.enumerate(this.steps))) { if (py.truth(step.routine)) $out.push([k, py.frozenset(formal_names(py.at(this.statements, k), undefined, this.case))]); } return $out; })());
return null;
}
target(k, part) {
let found, is_part, line, name;
line = py.at(this.statements, k).line;
found = this.literal(line, ("target of line " + py.str(line)), part);
if (((found) ?? null) !== (null)) {
return found;
}
[name, is_part] = [...py.iter(element_name(part, this.case))];
if (py.truth(py.both(name, () => py.both(!py.truth(is_part), () => !py.truth(py.call(name, "startswith", "$")))))) {
return (py.has(this.parameters(k), name) ? this.skip(name, line, PARAMETER) : name);
}
this.draft.read(this.words(part));
this.pass_arguments(line, part);
return this.skip(py.text(text_of_items(part, this.case)).slice(undefined, 40), line, "a computed position");
return null;
}
frame(k, items, computed) {
let is_part, name;
[name, is_part] = [...py.iter(element_name(items, this.case))];
if (py.truth(py.either(!py.truth(name), () => py.either(is_part, () => py.has(name, "*"))))) {
return new Frame("", undefined, computed);
}
return new Frame(name, undefined, (py.has(this.parameters(k), name) ? (py.str(name) + " is " + py.str(PARAMETER)) : ""));
return null;
}
assign(line, name, is_part, value) {
let found;
found = (py.truth(py.either(is_part, () => py.has(name, "*"))) ? null : this.literal(line, name, value));
if (((found) ?? null) !== (null)) {
this.draft.take(found);
return null;
}
this.draft.write(name, ("line " + py.str(line) + " sets " + py.str((py.truth(is_part) ? "a part of it" : "it")) + " while the program runs"));
this.draft.derive(name, this.words(value));
return null;
}
pass_arguments(line, items) {
let called, group;
for (const $each of py.iter(calls_in(items))) {
[called, group] = $each;
if (!py.has(this.harmless, (py.truth(this.case) ? called : py.call(called, "upper")))) {
this.draft.pass_to(called, (() => { const $out = []; for (const part of py.iter(group.parts)) { $out.push(py.at(element_name(part, this.case), 0)); } return $out; })(), line);
}
}
return null;
}
displaced(k, kinds) {
let called, found, kind, known;
known = py.at(this.flow, k);
for (const $each of py.iter(kinds)) {
kind = $each;
found = py.call(known.setters, "get", kind);
if (py.truth(py.isinstance(found, ["int"]))) {
if (!py.truth(this.entries.ends(py.at(this.statements, found)))) {
called = text_of_items(py.text(py.at(this.statements, found).items).slice(undefined, 1), true);
return ("line " + py.str(py.at(this.statements, found).line) + " displaces positions (" + py.str(called) + ")");
}
} else {
if (((found) ?? null) !== (null)) {
return ("positions may be displaced (" + py.str(kind) + "): " + py.str(found));
} else {
if (py.truth(this.starts_displaced(k, kind))) {
return ("positions may be displaced (" + py.str(kind) + "): another routine does so");
}
}
}
}
return "";
return null;
}
starts_displaced(k, kind) {
let routine;
routine = this.code.routine(k);
return py.both(py.bool(routine), () => py.has(this.entries.displaced_at_start(kind), routine));
return null;
}
load(k) {
let found, known, statement;
known = py.at(this.flow, k);
found = py.call(known.setters, "get", STATED_LOAD);
if (py.truth(py.isinstance(found, ["int"]))) {
statement = py.at(this.statements, found);
return new Load(text_of_items(statement.items), statement.line, this.mass(statement));
}
if (py.truth(py.both(((found) ?? null) === (null), () => this.starts_displaced(k, STATED_LOAD)))) {
found = "it is set by another routine";
}
return (((found) ?? null) !== (null) ? new Load(found, py.at(this.statements, k).line) : null);
return null;
}
mass(statement) {
throw NotImplementedError;
return null;
}
left(target, reason) {
if (py.truth(py.isinstance(target, [Point]))) {
return target.skip(reason);
}
if (py.truth(py.isinstance(target, ["str"]))) {
this.draft.write(target, reason);
}
return target;
return null;
}
}
Reader.prototype.case = false;
py.cached(Reader.prototype, "_parameters");
class Entries {
constructor(files = null, ends = null, lasting = [], known = py.dict()) {
this.files = files;
this.ends = ends;
this.lasting = lasting;
this.known = known;
}
displaced_at_start(kind) {
if (!py.has(this.known, kind)) {
py.put(this.known, kind, this._displaced_at_start(kind));
}
return py.at(this.known, kind);
return null;
}
_displaced_at_start(kind) {
let code, k, starts;
starts = new _Starts(kind, this.ends);
for (const $each of py.iter(this.files)) {
code = $each;
for (const $each of py.iter(py.range(py.len(code.steps)))) {
k = $each;
starts.look_at(code, k);
}
}
return starts.displaced(py.has(this.lasting, kind));
return null;
}
}
class _Starts {
constructor(kind = null, ends = null, found = py.set(), called = py.set(), heirs = py.dict(), is_clean = py.dict()) {
this.kind = kind;
this.ends = ends;
this.found = found;
this.called = called;
this.heirs = heirs;
this.is_clean = is_clean;
}
look_at(code, k) {
let is_clean, is_end, name, routine, state, step;
step = py.at(code.steps, k);
state = py.call(py.at(code.flow, k).setters, "get", this.kind);
is_clean = py.either(((state) ?? null) === (null), () => py.both(py.isinstance(state, ["int"]), () => this.ends(py.at(code.statements, state))));
this.called = py.or(this.called, py.set(step.calls));
this.found = py.or(this.found, py.set(step.starts));
routine = code.routine(k);
for (const $each of py.iter(step.calls)) {
name = $each;
if (!py.truth(is_clean)) {
py.call(this.found, "add", name);
} else {
if (((state) ?? null) === (null)) {
py.call(py.call(this.heirs, "setdefault", routine, []), "append", name);
}
}
}
is_end = py.both(py.bool(step.closes), () => py.bool(py.at(code.steps, py.at(py.at(code.flow, k).blocks, -1)).routine));
if (py.truth(py.either(is_end, () => leaves(py.at(code.statements, k))))) {
py.put(this.is_clean, routine, py.both(is_clean, () => py.call(this.is_clean, "get", routine, true)));
}
return null;
}
displaced(lasts) {
let ahead, ended, found, name;
found = py.set(this.found);
if (py.truth(lasts)) {
ended = py.call(this.is_clean, "items");
found = py.or(found, new Set((() => { const $out = []; for (const [name, is_clean] of py.iter(ended)) { if (!py.truth(py.either(is_clean, () => py.has(this.called, name)))) $out.push(name); } return $out; })()));
}
ahead = py.sorted(found);
while (py.truth(ahead)) {
for (const $each of py.iter(py.call(this.heirs, "get", py.call(ahead, "pop"), []))) {
name = $each;
if (!py.has(found, name)) {
py.call(found, "add", name);
py.call(ahead, "append", name);
}
}
}
return py.frozenset(found);
return null;
}
}
function formal_names(statement, kinds = [], case_ = false) {
let found, item, part, piece, words;
found = [];
for (const $each of py.iter(statement.items)) {
item = $each;
for (const $each of py.iter((py.truth(py.isinstance(item, [Brackets])) ? item.parts : []))) {
part = $each;
for (const $each of py.iter(split(part, "\\"))) {
piece = $each;
words = py.list(words_in(py.at(split(piece, ":"), 0), case_));
if (py.truth(py.both(words, () => py.either(!py.truth(kinds), () => py.and(py.set(kinds), py.set(words)))))) {
py.call(found, "append", py.at(words, -1));
}
}
}
}
return found;
return null;
}
return { PARAMETER, EXTERNAL, Reader, Entries, _Starts, formal_names };
})();
MODULES.language = (() => {
const { Motion, Point, Posture, Program, Turn, number_text } = MODULES.program;
const { Number } = MODULES.syntax;
const { Understood } = MODULES.understood;
class ControllerLanguage {
read(sources) {
return null;
}
statement(motion, source, values, posture) {
throw NotImplementedError;
return null;
}
key(name) {
return py.call(name, "upper");
return null;
}
with_pulses(text) {
throw new BadInputError(("pulses " + py.repr(text) + ": a program in " + py.str(this.name) + " has none; leave --pulses out"));
return null;
}
refusal(point) {
if (py.truth(py.either(py.same(point.kind, "joints"), () => this.is_pose(point.values)))) {
return "";
}
return "its numbers are no pose: too large, or a quaternion that is not of unit length";
return null;
}
point_numbers(point, values) {
let angle, joint, least, length;
[length, angle, joint] = [...py.iter(this.digits)];
least = (() => { const $out = []; for (const k of py.iter(py.range(py.len(point.numbers)))) { $out.push((py.same(point.kind, "joints") ? joint : ((k < 3) ? length : angle))); } return $out; })();
return (() => { const $out = []; for (const [k, number] of py.iter(py.enumerate(point.numbers))) { $out.push(number_text(number, py.float(py.at(values, k)), py.at(least, k))); } return $out; })();
return null;
}
turn_text(turns, axes, before) {
let count, counts, number, turn, value, were;
number = py.at(turns, 0).number;
counts = (() => { const $out = []; for (const turn of py.iter(turns)) { $out.push(turn.counted(py.float(py.at(axes, turn.joint)))); } return $out; })();
were = (() => { const $out = []; for (const turn of py.iter(turns)) { $out.push(turn.counted(py.float(py.at(before, turn.joint)))); } return $out; })();
counts = (() => { const $out = []; for (const [turn, new_, old] of py.iter(py.zip(turns, counts, were))) { $out.push((py.same(new_, old) ? turn.value : new_)); } return $out; })();
if (py.truth(py.all((() => { const $out = []; for (const [count, turn] of py.iter(py.zip(counts, turns))) { $out.push(py.same(count, turn.value)); } return $out; })()))) {
return number.text;
}
if (((py.at(turns, 0).bit) ?? null) === (null)) {
return py.str(py.at(counts, 0));
}
value = py.int(number.value);
for (const $each of py.iter(py.zip(turns, counts))) {
[turn, count] = $each;
value = py.or(py.and(value, ~(1 << py.either(turn.bit, () => 0))), (count << py.either(turn.bit, () => 0)));
}
return this.bits(number, value);
return null;
}
bits(number, value) {
return py.str(value);
return null;
}
}
ControllerLanguage.prototype.is_pair = false;
ControllerLanguage.prototype.reads_others = false;
ControllerLanguage.prototype.length = 0.001;
ControllerLanguage.prototype.convention = "fanuc";
ControllerLanguage.prototype.in_degrees = true;
ControllerLanguage.prototype.digits = [4, 6, 7];
ControllerLanguage.prototype.can_insert = false;
ControllerLanguage.prototype.understood = [];
ControllerLanguage.prototype.grammars = [];
return { ControllerLanguage };
})();
MODULES.fanuc_lines = (() => {
const { ANY, POSITIONS, STATED_LOAD, BlockPart, Line } = MODULES.line_flow;
const { Understood, first_phrase, not_understood, tokens_of, understood_words, without_brackets } = MODULES.understood;
let _MANUAL;
_MANUAL = "FANUC R-30iA/R-30iB, operator's manual (basic operation), chapter 4";
let _ARC;
_ARC = "FANUC R-30iB, arc welding operator's manual, arc and weave instructions";
let _SPOT;
_SPOT = "FANUC R-30iB, spot welding operator's manual, program instructions";
let _GERMAN;
_GERMAN = "FANUC R-30iA/R-30iB, the same in German system software";
let LISTING_WORDS;
LISTING_WORDS = [new Understood("instruction", (py.str(_MANUAL) + ": branch, program control, wait and condition monitor instructions"), "LBL, JMP, CALL, RUN, IF, ELSE, ENDIF, SELECT, FOR, ENDFOR, END, WAIT, PAUSE, ABORT, WHEN, MONITOR, MONITOR END, TIMEOUT, RESUME_PROG, ENABLE RESUME_PROG, CLEAR RESUME_PROG, THEN"), new Understood("instruction", "FANUC, listings of the VASS standard: the condition on which a motion may go on", "TC_ONLINE"), new Understood("instruction", (py.str(_MANUAL) + ": conditions of skips and offsets, which act on motions with that option only"), "SKIP CONDITION, OFFSET CONDITION, TOOL_OFFSET CONDITION, VOFFSET CONDITION, LOCK PREG, UNLOCK PREG"), new Understood("instruction", (py.str(_MANUAL) + ": miscellaneous instructions"), "RSR, UALM, TIMER, OVERRIDE, REMARK, MESSAGE, PAYLOAD, COL DETECT ON, COL DETECT OFF, COL GUARD ADJUST, JOINT_MAX_SPEED, LINEAR_MAX_SPEED, DIAG_REC, POINT_LOGIC, STRLEN, SUBSTR, FINDSTR, VISION RUN_FIND, VISION GET_OFFSET, VISION GET_NFOUND, VISION GET_PASSFAIL, SAVE_LOG"), new Understood("instruction", _ARC, "ARC START, ARC END, WEAVE, WEAVE SINE, WEAVE FIGURE, WEAVE CIRCLE, WEAVE L, WEAVE END, WIRE FORWARD, WIRE BACKWARD"), new Understood("instruction", _SPOT, "SPOT, BACKUP, STROKE, BU, SS, SE, HAND OPEN, HAND CLOSE"), new Understood("variable", (py.str(_MANUAL) + ": registers, inputs and outputs, frame numbers, speeds, parameters"), "R, PR, SR, AR, PL, DI, DO, RI, RO, GI, GO, AI, AO, SI, SO, UI, UO, WI, WO, WSI, WSO, SDI, SDO, RDI, RDO, GDI, GDO, M, F, LO, TIMER, OVERRIDE, UFRAME_NUM, UTOOL_NUM, JOINT_MAX_SPEED, LINEAR_MAX_SPEED, UALM, RSR, $MCR.$GENOVERRIDE, $WAITTMOUT, $SPEED, $MCR.$PRGOVERRIDE, $MCR_GRP.$PRGOVERRIDE"), new Understood("variable", _GERMAN, "BENUTZER_NUM, WKZ_NUM"), new Understood("option", (py.str(_MANUAL) + ": speed and positioning path of a motion"), "FINE, CNT, CR, CD, MM/SEC, CM/MIN, INCH/MIN, IN/MIN, DEG/SEC, SEC, MSEC, MM, MAX_SPEED, WELD_SPEED, R, AR, PSPD"), new Understood("option", (py.str(_MANUAL) + ": additional motion instructions without an offset; what they switch or call"), "ACC, WJNT, MROT, PTH, RT_LD, AP_LD, BREAK, EV, IND.EV, TB, TA, DB, CALL, P-SPS, DO, RO, GO, AO, F, ON, OFF, PULSE, POINT_LOGIC, ALIM"), new Understood("option", _ARC, "ARC START, ARC END, WEAVE, WEAVE SINE, WEAVE FIGURE, WEAVE CIRCLE, WEAVE L, WEAVE END"), new Understood("option", _SPOT, "SPOT, SS, SE")];
let _INSTRUCTIONS;
_INSTRUCTIONS = understood_words(LISTING_WORDS, "instruction");
let _VARIABLES;
_VARIABLES = understood_words(LISTING_WORDS, "variable");
let _OPTIONS;
_OPTIONS = understood_words(LISTING_WORDS, "option");
let COMPUTED;
COMPUTED = "moved by an offset";
let _MOVED;
_MOVED = py.frozenset(["OFFSET", "TOOL_OFFSET", "VOFFSET", "COORD", "RTCP", "PTH_OFFSET", "WKZ_OFFSET"]);
let _BEGINS;
_BEGINS = new py.Dict([["TOUCH OFFSET", "touch offset"], ["TRACK", "tracking"], ["SOFTFLOAT", "soft float"]]);
let _ENDS;
_ENDS = new py.Dict([["TOUCH OFFSET END", "touch offset"], ["TRACK END", "tracking"], ["SOFTFLOAT END", "soft float"]]);
let SWITCHED;
SWITCHED = [...py.iter(py.call(_BEGINS, "values")), POSITIONS];
let _PHRASES;
_PHRASES = py.frozenset([...py.iter(_INSTRUCTIONS), ...py.iter(_BEGINS), ...py.iter(_ENDS)]);
let _FRAMES;
_FRAMES = new py.Dict([["UTOOL", "tool"], ["UFRAME", "base"]]);
let _CONDITIONS;
_CONDITIONS = ["IF", "WHEN", "ELSE", "SELECT"];
let _BLOCKS;
_BLOCKS = new py.Dict([["FOR", "loop"], ["ENDFOR", "end"], ["ENDIF", "end"]]);
function why_moved_by_options(options, line) {
let k, phrase, tokens;
tokens = tokens_of(without_brackets(options));
k = 0;
while ((k < py.len(tokens))) {
phrase = first_phrase(py.text(tokens).slice(k, py.add(k, 3)), _OPTIONS);
if (py.same(phrase, "INC")) {
return ("a relative motion (INC), line " + py.str(line));
}
if (py.same(phrase, "SKIP")) {
return ("a search (Skip), line " + py.str(line));
}
if (py.has(_MOVED, phrase)) {
return (py.str(COMPUTED) + " (" + py.str(phrase) + ")");
}
if (py.truth(py.both(phrase, () => !py.has(_OPTIONS, phrase)))) {
return ("line " + py.str(line) + ": " + py.repr(phrase) + " is not understood and may displace it");
}
k = py.add(k, (py.same(phrase, "CALL") ? 2 : py.len(py.call(phrase, "split", " "))));
}
return "";
return null;
}
function effect_of_options(options, number) {
return new Line(number, undefined, undefined, undefined, _jumps(options), _calls(options));
return null;
}
function effect_in_listing(text, number) {
let action, block, calls, first, flat, is_condition, jumps, phrase, sets, tokens;
flat = without_brackets(text);
tokens = tokens_of(flat);
first = (py.truth(tokens) ? py.at(tokens, 0) : "");
is_condition = py.either(py.has(_CONDITIONS, first), () => py.call(flat, "startswith", "="));
jumps = _jumps(text);
calls = _calls(text);
block = py.call(_BLOCKS, "get", first, "");
if (py.truth(is_condition)) {
if (py.truth(py.call(py.call(flat, "strip", " ;"), "endswith", "THEN"))) {
block = "branch";
} else {
if (py.truth(py.both(py.same(first, "ELSE"), () => !py.has(flat, ",")))) {
block = "else";
}
}
action = py.at(py.call(flat, "partition", ","), 2);
sets = py.tuple(_sets(action, text, number));
return new Line(number, sets, undefined, undefined, jumps, calls, undefined, block);
}
phrase = first_phrase(tokens, _PHRASES);
return new Line(number, py.tuple(_sets(flat, text, number)), (py.same(phrase, "PAYLOAD") ? [STATED_LOAD] : (py.has(_ENDS, phrase) ? [py.at(_ENDS, phrase)] : [])), _label(text), jumps, calls, py.has(["JMP", "END", "ABORT"], first), block);
return null;
}
function* _sets(flat, text, number) {
let found, index, left, name, phrase, target, tokens;
tokens = tokens_of(flat);
if (!py.truth(py.any(tokens))) {
return null;
}
left = tokens_of(py.at(py.call(flat, "partition", "="), 0));
phrase = first_phrase(tokens, _PHRASES);
target = (py.truth(left) ? py.at(left, 0) : "");
if (py.truth(py.both(py.has(flat, "="), () => py.has(_FRAMES, target)))) {
index = number_in_brackets(py.at(py.call(py.at(py.call(py.call(text, "upper"), "partition", (py.str(target) + "[")), 2), "partition", "]"), 0));
name = (py.str(py.at(_FRAMES, target)) + " " + py.str((py.truth(py.call(index, "isdigit")) ? index : ANY)));
(yield [name, ("line " + py.str(number) + " sets it while the program runs")]);
} else {
if (py.truth(py.both(py.has(flat, "="), () => !py.has(_INSTRUCTIONS, phrase)))) {
if (!py.has(_VARIABLES, target)) {
(yield [POSITIONS, ("line " + py.str(number) + ": " + py.str(not_understood(text)))]);
}
} else {
if (py.has(_ENDS, phrase)) {
return null;
} else {
if (py.same(phrase, "PAYLOAD")) {
(yield [STATED_LOAD, (py.str(number) + " " + py.str(text))]);
} else {
if (py.truth(py.either(py.has(_BEGINS, phrase), () => py.has(_BEGINS, py.at(tokens, 0))))) {
found = py.call(_BEGINS, "get", phrase, py.call(_BEGINS, "get", py.at(tokens, 0), ""));
(yield [found, ("line " + py.str(number) + " displaces positions (" + py.str(py.call(py.text(text).slice(undefined, 40), "strip")) + ")")]);
} else {
if (!py.has(_INSTRUCTIONS, phrase)) {
(yield [POSITIONS, ("line " + py.str(number) + ": " + py.str(not_understood(text)))]);
}
}
}
}
}
}
}
function number_in_brackets(text) {
let _, first, more;
[first, , more] = [...py.iter(py.call(text, "partition", ":"))];
return py.call(py.at(py.call((py.truth(py.call(py.call(first, "strip"), "startswith", "GP")) ? more : first), "partition", ","), 0), "strip");
return null;
}
function _label(text) {
let upper;
upper = py.call(py.call(text, "upper"), "strip");
return (py.truth(py.call(upper, "startswith", "LBL[")) ? py.at(_indices(upper), 0) : "");
return null;
}
function _jumps(text) {
let upper;
upper = py.call(py.call(text, "upper"), "strip");
return (py.truth(py.call(upper, "startswith", "LBL[")) ? [] : _indices(upper));
return null;
}
function _indices(text) {
let found;
found = (() => { const $out = []; for (const piece of py.iter(py.text(py.call(text, "split", "LBL[")).slice(1, undefined))) { $out.push(py.call(py.at(py.call(py.at(py.call(piece, "partition", "]"), 0), "partition", ":"), 0), "strip")); } return $out; })();
return py.tuple((() => { const $out = []; for (const index of py.iter(found)) { $out.push((py.truth(py.call(index, "isdigit")) ? index : ANY)); } return $out; })());
return null;
}
function _calls(text) {
let found, name, piece, word;
found = [];
for (const $each of py.iter(["CALL ", "RUN "])) {
word = $each;
for (const $each of py.iter(py.text(py.call(py.call(text, "upper"), "split", word)).slice(1, undefined))) {
piece = $each;
name = py.call(py.at(py.call(py.at(py.call(py.at(py.call(py.call(piece, "strip"), "partition", "("), 0), "partition", ","), 0), "partition", ";"), 0), "split");
py.call(found, "append", (py.truth(py.either(!py.truth(name), () => py.has(py.at(name, 0), "["))) ? ANY : py.at(name, 0)));
}
}
return py.tuple(found);
return null;
}
return { _MANUAL, _ARC, _SPOT, _GERMAN, LISTING_WORDS, _INSTRUCTIONS, _VARIABLES, _OPTIONS, COMPUTED, _MOVED, _BEGINS, _ENDS, SWITCHED, _PHRASES, _FRAMES, _CONDITIONS, _BLOCKS, why_moved_by_options, effect_of_options, effect_in_listing, _sets, number_in_brackets, _label, _jumps, _indices, _calls };
})();
MODULES.jbi_lines = (() => {
const { ANY, POSITIONS, BlockPart, Line } = MODULES.line_flow;
const { Understood, not_understood, understood_words, without_brackets } = MODULES.understood;
let _MANUAL;
_MANUAL = "Yaskawa DX200, INFORM language manual, chapter 2";
let JOB_WORDS;
JOB_WORDS = [new Understood("instruction", (py.str(_MANUAL) + ": control instructions"), "NOP, END, JUMP, CALL, RET, TIMER, WAIT, LABEL, COMM, IF, IFTHEN, IFTHENEXP, ELSEIF, ELSEIFEXP, ELSE, ENDIF, UNTIL, PAUSE, ABORT, CWAIT, ADVINIT, ADVSTOP, MSG, CLS, DIALOG, WHILE, WHILEEXP, ENDWHILE, FOR, NEXT, SWITCH, CASE, DEFAULT, ENDSWITCH, PSTART, PWAIT, TSYNC, SETUALM, SHCKSET, SHCKRST, NWAIT, SPEED, RETURN"), new Understood("instruction", (py.str(_MANUAL) + ": input and output instructions"), "DOUT, DIN, AOUT, ARATION, ARATIOF, PULSE, SETOUT"), new Understood("instruction", (py.str(_MANUAL) + ": operating instructions; a position variable that they set is left"), "SET, SETE, GETE, GETS, GETPOS, GETARG, INC, DEC, ADD, SUB, MUL, DIV, CNVRT, CLEAR, SIN, COS, ATAN, SQRT, AND, OR, NOT, XOR, MULMAT, INVMAT, GETFILE, SETREG, GETREG, MSHIFT, CNVR, VAL, ASC, CHR$, MID$, LEN, CAT$, VAL2STR, PRINT, SWAP"), new Understood("instruction", (py.str(_MANUAL) + ": work instructions (arc and spot welding, handling)"), "ARCON, ARCOF, ARCSET, ARCCTS, ARCCTE, AWELD, VWELD, WVON, WVOF, REFP, ANTSTICK, SPOT, SVSPOT, SVSPOTMOV, SVGUNCL, GUNCL, STROKE, HAND, TOOLON, TOOLOF, CUTON, CUTOF"), new Understood("option", (py.str(_MANUAL) + ": move instructions (speed, position level, acceleration, no wait)"), "VJ, V, VR, VE, PL, CR, ACC, DEC, NWAIT, FPT, EC, EX")];
let _INSTRUCTIONS;
_INSTRUCTIONS = understood_words(JOB_WORDS, "instruction");
let _OPTIONS;
_OPTIONS = understood_words(JOB_WORDS, "option");
let SHIFT;
SHIFT = "shift";
let _VARIABLES;
_VARIABLES = ["B", "I", "D", "R", "S", "P", "PX", "B[]", "I[]", "D[]", "R[]", "S[]", "P[]", "PX[]"];
let _BEGINS;
_BEGINS = ["SFTON", "MFRAME", "PMTON", "SYSTART"];
let _ENDS;
_ENDS = ["SFTOF", "PMTOF", "SYEND"];
let _BLOCKS;
_BLOCKS = new py.Dict([["WHILE", "loop"], ["WHILEEXP", "loop"], ["FOR", "loop"], ["IFTHEN", "branch"], ["IFTHENEXP", "branch"], ["SWITCH", "branch"], ["ELSEIF", "else"], ["ELSEIFEXP", "else"], ["ELSE", "else"], ["CASE", "else"], ["DEFAULT", "else"], ["ENDIF", "end"], ["ENDSWITCH", "end"], ["ENDWHILE", "end"], ["NEXT", "end"]]);
function effect_in_job(text, number) {
let first, is_always, is_call, jobs, labels, rest, words;
words = py.call(py.call(without_brackets(text, false), "replace", "=", " = "), "split");
first = (py.truth(words) ? py.at(words, 0) : "");
if (py.truth(py.call(first, "startswith", "*"))) {
return new Line(number, undefined, undefined, first);
}
rest = py.text(words).slice(1, undefined);
labels = py.tuple((() => { const $out = []; for (const word of py.iter(rest)) { if (py.truth(py.call(word, "startswith", "*"))) $out.push(word); } return $out; })());
is_call = py.has(["CALL", "PSTART"], first);
jobs = (() => { const $out = []; for (const word of py.iter(rest)) { if (py.truth(py.call(word, "startswith", "JOB:"))) $out.push(py.call(word, "removeprefix", "JOB:")); } return $out; })();
is_always = !py.has(rest, "IF");
return new Line(number, _sets((py.truth(_sets_no_variable(words)) ? "SET of no variable" : first), text, number), (py.truth(py.both(py.has(_ENDS, first), () => is_always)) ? [SHIFT] : []), undefined, labels, py.either(py.tuple(jobs), () => (py.truth(is_call) ? [ANY] : [])), py.both(py.has(["JUMP", "RET", "END"], first), () => is_always), py.call(_BLOCKS, "get", first, ""));
return null;
}
function _sets_no_variable(words) {
let name;
name = ((py.len(words) > 1) ? py.call(py.call(py.at(words, 1), "lstrip", "L"), "rstrip", "0123456789") : "");
return py.both(py.same(py.text(words).slice(undefined, 1), ["SET"]), () => !py.has(_VARIABLES, name));
return null;
}
function _sets(first, text, number) {
if (py.has(_BEGINS, first)) {
return [[SHIFT, ("line " + py.str(number) + " shifts positions, or computes a frame from them")]];
}
if (py.truth(py.either(!py.truth(first), () => py.either(py.call(first, "startswith", "/"), () => py.either(py.has(_INSTRUCTIONS, first), () => py.has(_ENDS, first)))))) {
return [];
}
return [[POSITIONS, ("line " + py.str(number) + ": " + py.str(not_understood(text)))]];
return null;
}
function why_not_reached(options, number) {
let name, word;
for (const $each of py.iter(py.call(py.call(without_brackets(py.at(py.call(options, "partition", "+"), 0), false), "replace", "=", " = "), "split"))) {
word = $each;
name = py.call(word, "strip", "0123456789.#");
if (py.same(name, "UNTIL")) {
return ("a search (UNTIL), line " + py.str(number));
}
if (py.has(["=", "", "I", "B", "D", "R", "LI", "LB", "LD", "LR", "BC", "BP"], name)) {
continue;
}
if (!py.has(_OPTIONS, name)) {
return ("line " + py.str(number) + ": " + py.repr(name) + " is not understood and may displace it");
}
}
return "";
return null;
}
function named_in(text) {
let found, kind, sign, word;
found = [];
for (const $each of py.iter([",", "(", ")", "="])) {
sign = $each;
text = py.call(text, "replace", sign, " ");
}
for (const $each of py.iter(py.call(py.call(text, "upper"), "split"))) {
word = $each;
kind = py.call(word, "rstrip", "0123456789");
if (py.truth(py.both(py.has(["C", "P", "PX", "BC", "BP", "EC", "EX"], kind), () => !py.same(kind, word)))) {
py.call(found, "append", (py.str((py.same(kind, "PX") ? "P" : kind)) + py.str(py.call(word, "removeprefix", kind))));
}
}
return found;
return null;
}
return { _MANUAL, JOB_WORDS, _INSTRUCTIONS, _OPTIONS, SHIFT, _VARIABLES, _BEGINS, _ENDS, _BLOCKS, effect_in_job, _sets_no_variable, _sets, why_not_reached, named_in };
})();
MODULES.rapid_blocks = (() => {
const { Code, Step } = MODULES.flow;
const { STATED_LOAD } = MODULES.line_flow;
const { Path } = MODULES.program;
const { Brackets, Number, Statement, aggregate, calls_in, is_token, nested, numbers_of, place_of, split, text_of_items, word, words_in } = MODULES.syntax;
const { Understood, understood_words } = MODULES.understood;
let _TOKENS;
_TOKENS = "\nTEXT: /\"([^\"\\r\\n]|\"\")*\"/\nBITS.3: /\\x05/\nSIGN: /:=|[\u003c\u003e]=|[^\\x04\\s\\w()\\[\\]{}\"!;$#]/\n_END: \";\" | \"\\x04\"\nCOMMENT.5: /![^\\r\\n]*/\n%ignore COMMENT\n%ignore /[ \\t\\f\\r\\n\\xa0]+/\n";
let GRAMMAR;
GRAMMAR = nested(_TOKENS);
let _WORDS;
_WORDS = "RAPID: MODULE ... ENDMODULE with statements that end in ';'";
let _ROUTINES;
_ROUTINES = new py.Dict([["PROC", "ENDPROC"], ["FUNC", "ENDFUNC"], ["TRAP", "ENDTRAP"]]);
let _LOOPS;
_LOOPS = new py.Dict([["WHILE", "ENDWHILE"], ["FOR", "ENDFOR"]]);
let _BLOCKS;
_BLOCKS = new py.Dict([["MODULE", "ENDMODULE"], ["RECORD", "ENDRECORD"], ["IF", "ENDIF"], ["TEST", "ENDTEST"], ...py.iter(py.call(_ROUTINES, 'items')), ...py.iter(py.call(_LOOPS, 'items'))]);
let _CLOSES;
_CLOSES = new py.Dict((() => { const $out = []; for (const [opens, end] of py.iter(py.call(_BLOCKS, "items"))) { $out.push([end, [opens]]); } return $out; })());
let _HEADS;
_HEADS = new py.Dict([["IF", "THEN"], ["ELSEIF", "THEN"], ["FOR", "DO"], ["WHILE", "DO"], ["CASE", ":"], ["DEFAULT", ":"]]);
let _JUMPS;
_JUMPS = ["ELSE", "ELSEIF", "CASE", "DEFAULT", "ERROR", "UNDO", "BACKWARD"];
let _ALONE;
_ALONE = [...py.iter(_CLOSES), "ELSE", "ERROR", "UNDO", "BACKWARD"];
let _CONDITIONS;
_CONDITIONS = ["IF", "TEST", ...py.iter(_LOOPS)];
let _LEAVING;
_LEAVING = ["RETURN", "EXITCYCLE", "EXIT", "GOTO", "RAISE", "RETRY", "TRYNEXT", "STOP", "BREAK"];
let _HANDLERS;
_HANDLERS = ["ERROR", "UNDO", "BACKWARD"];
let _NONE;
_NONE = 8900000000.0;
let ONCE;
ONCE = "IF without THEN";
let _STORAGE;
_STORAGE = ["CONST", "PERS", "VAR", "LOCAL", "TASK", "ALIAS"];
let _PLAIN;
_PLAIN = new py.Dict([["MOVEL", "line"], ["MOVEJ", "joint"], ["MOVEC", "circle"], ["MOVEABSJ", "joint"]]);
_PLAIN = py.or(_PLAIN, new py.Dict((() => { const $out = []; for (const [name, path] of py.iter(py.call(_PLAIN, "items"))) { for (const more of py.iter(["DO", "AO", "GO", "SYNC"])) { if (!py.same(name, "MOVEABSJ")) $out.push([(py.str(name) + py.str(more)), path]); } } return $out; })()));
let OF_OPTIONS;
OF_OPTIONS = new py.Dict((() => { const $out = []; for (const [name, kinds, ends] of py.iter([["TRIGG", "LJC", [""]], ["TRIGG", "LJ", ["IOS"]], ["ARC", "LC", ["", "START", "END", "1", "2"]], ["SPOT", "LJ", [""]], ["CAP", "LC", [""]], ["DISP", "LC", [""]], ["PAINT", "LC", [""]]])) { for (const kind of py.iter(kinds)) { for (const more of py.iter(ends)) { $out.push([(py.str(name) + py.str(kind) + py.str(more)), py.at(new py.Dict([["L", "line"], ["J", "joint"], ["C", "circle"]]), kind)]); } } } return $out; })());
let MOTIONS;
MOTIONS = new py.Dict([...py.iter(py.call(_PLAIN, 'items')), ...py.iter(py.call(OF_OPTIONS, 'items'))]);
let _MANUAL;
_MANUAL = "ABB, technical reference manual: RAPID instructions, functions and data types";
let RAPID_WORDS;
RAPID_WORDS = [new Understood("instruction", (py.str(_MANUAL) + ": program flow, waiting, errors, interrupts"), "IF, ELSEIF, ELSE, ENDIF, FOR, ENDFOR, WHILE, ENDWHILE, TEST, CASE, DEFAULT, ENDTEST, GOTO, RETURN, EXIT, EXITCYCLE, STOP, BREAK, RAISE, RETRY, TRYNEXT, RESETRETRYCOUNT, WAITTIME, WAITUNTIL, WAITDI, WAITDO, WAITGI, WAITGO, WAITAI, WAITAO, WAITROB, WAITSYNCTASK, CONNECT, IDELETE, IDISABLE, IENABLE, ISLEEP, IWATCH, ISIGNALDI, ISIGNALDO, ISIGNALGI, ISIGNALGO, ISIGNALAI, ISIGNALAO, ITIMER, IPERS, IERROR, ERRLOG, ERRRAISE, ERRWRITE, BOOKERRNO, SYSTEMSTOPACTION, STOPMOVE, STOPMOVERESET, STARTMOVE, CLEARPATH, STOREPATH, RESTOPATH, TRIGGIO, TRIGGEQUIP, TRIGGINT, TRIGGCHECKIO, TRIGGRAMPAO, TRIGGSPEED, TRIGGSTOPPROC, AND, OR, NOT, XOR, TRUE, FALSE, ACTEVENTBUFFER, DEACTEVENTBUFFER, CHECKPROGREF, GETTRAPDATA, IRMQMESSAGE, IVARVALUE, PATHRECSTART, PATHRECSTOP, PATHLENGTHSTART, PATHLENGTHSTOP, PATHLENGTHRESET, RAISETOUSER, SKIPWARN, STARTMOVERETRY, TRIGGDATACOPY, TRIGGDATARESET, WAITTESTANDSET"), new Understood("instruction", (py.str(_MANUAL) + ": motion settings that keep target and tool"), "ACCSET, VELSET, SPEEDREFRESH, CONFL, CONFJ, PATHACCLIM, PATHRESOL, WORLDACCLIM, CIRPATHMODE, MOTIONSUP, GRIPLOAD, MECHUNITLOAD, SETSYSDATA, TUNESERVO, TUNERESET, WZBOXDEF, WZSPHDEF, WZCYLDEF, WZLIMJOINTDEF, WZHOMEJOINTDEF, WZLIMSUP, WZDOSET, WZENABLE, WZDISABLE, WZFREE, ARCREFRESH, CORNERPATHWARNING, MOTIONPROCESSMODESET, SPEEDLIMAXIS, SPEEDLIMCHECKPOINT"), new Understood("instruction", (py.str(_MANUAL) + ": inputs, outputs, operator, files, clocks, numbers"), "SETDO, SETGO, SETAO, SET, RESET, INVERTDO, PULSEDO, IOENABLE, IODISABLE, ALIASIO, TPWRITE, TPERASE, TPREADNUM, TPREADDNUM, TPREADFK, TPSHOW, UIMSGBOX, UIMSGWRITE, UISHOW, OPEN, CLOSE, WRITE, WRITEBIN, WRITEANYBIN, WRITESTRBIN, WRITERAWBYTES, READRAWBYTES, PACKRAWBYTES, UNPACKRAWBYTES, CLEARRAWBYTES, COPYRAWBYTES, CLEARIOBUFF, REWIND, SOCKETCREATE, SOCKETCONNECT, SOCKETSEND, SOCKETRECEIVE, SOCKETCLOSE, SOCKETBIND, SOCKETLISTEN, SOCKETACCEPT, CLKSTART, CLKSTOP, CLKRESET, INCR, DECR, ADD, CLEAR, BITSET, BITCLEAR, GETSYSDATA, MAKEDIR, REMOVEDIR, REMOVEFILE, RENAMEFILE, COPYFILE, SPYSTART, SPYSTOP, PROCERRRECOVERY, WARMSTART, ACTUNIT, DEACTUNIT, CAMFLUSH, CAMGETRESULT, CAMLOADJOB, CAMREQIMAGE, CAMSETPROGRAMMODE, CAMSETRUNMODE, CLOSEDIR, IOBUSSTART, IOBUSSTATE, OPENDIR, RMQSENDMESSAGE, SOCKETRECEIVEFROM, SOCKETSENDTO, TESTSIGNDEFINE, TESTSIGNRESET, UIMSGWRITEABORT"), new Understood("function", (py.str(_MANUAL) + ": functions, none of which changes an argument"), "OFFS, RELTOOL, POSEMULT, POSEINV, POSEVECT, DEFFRAME, DEFACCFRAME, CROBT, CJOINTT, CPOS, CTOOL, CWOBJ, CALCJOINTT, CALCROBT, ORIENTZYX, EULERZYX, DISTANCE, VECTMAGN, DOTPROD, CROSSPROD, NORIENT, MIRPOS, ROBOS, ABS, SQRT, SIN, COS, TAN, ACOS, ASIN, ATAN, ATAN2, ROUND, TRUNC, POW, EXP, NUMTOSTR, DNUMTONUM, NUMTODNUM, VALTOSTR, DIM, AND, OR, NOT, XOR, DIV, MOD, RETURN, IF, WHILE, ELSEIF, TEST, UNTIL, DOUTPUT, DINPUT, GOUTPUT, AINPUT, AOUTPUT, TESTDI, CLKREAD, CDATE, CTIME, GETTIME, STRLEN, STRPART, STRFIND, STRMATCH, PRESENT, ISPERS, ISVAR, BITAND, BITOR, BITXOR, BITNEG, BITLSH, BITRSH, BITCHECK, OPMODE, RUNMODE, ROBNAME, TASKRUNROB, UIMESSAGEBOX, UINUMENTRY, UILISTVIEW, READNUM, READSTR, READBIN, ARGNAME, CSPEEDOVERRIDE"), new Understood("filler", (py.str(_MANUAL) + ": StrToVal, which writes to its second argument"), "STRTOVAL"), new Understood("option", (py.str(_MANUAL) + ": optional arguments of MoveAbsJ, MoveC, MoveJ, MoveL, TriggL, ArcL, SpotL"), "CONC, ID, V, T, Z, INPOS, WOBJ, NOEOFFS, TLOAD, CORR, START, TIME, DO, SDO, END, SEAMNAME, SEAM, WELD, WEAVE, T1, T2, T3, T4, T5, T6, T7, T8, CONFL, QUICKREL, OPENHLIFT, CLOSEHLIFT, NEXT, SYNC, RETRACT, TRIGGDATA1, TRIGGDATA2, TRIGGDATA3")];
let _INSTRUCTIONS;
_INSTRUCTIONS = understood_words(RAPID_WORDS, "instruction");
let RAPID_FUNCTIONS;
RAPID_FUNCTIONS = understood_words(RAPID_WORDS, "function");
let _FILLERS;
_FILLERS = understood_words(RAPID_WORDS, "filler");
let MOTION_OPTIONS;
MOTION_OPTIONS = understood_words(RAPID_WORDS, "option");
let SWITCHES;
SWITCHES = new py.Dict([["PDISPON", "PDISP"], ["PDISPSET", "PDISP"], ["PDISPOFF", "PDISP"], ["EOFFSON", "EOFFS"], ["EOFFSSET", "EOFFS"], ["EOFFSOFF", "EOFFS"], ["CORRCON", "CORR"], ["CORRWRITE", "CORR"], ["CORRDISCON", "CORR"], ["CORRCLEAR", "CORR"], ["SINGAREA", "SINGAREA"], ["SOFTACT", "SOFT"], ["SOFTDEACT", "SOFT"], ["DITHERACT", "SOFT"], ["CSSACT", "CSS"], ["CSSDEACTMOVEL", "CSS"], ["CSSOFFSETTUNE", "CSS"], ["CSSFORCEOFFSETACT", "CSS"], ["CSSDEACT", "CSS"], ["SYNCMOVEON", "SYNCMOVE"], ["SYNCMOVERESUME", "SYNCMOVE"], ["SYNCMOVEOFF", "SYNCMOVE"], ["SYNCMOVESUSPEND", "SYNCMOVE"], ["WAITWOBJ", "CONVEYOR"], ["DROPWOBJ", "CONVEYOR"], ["SYNCWWOBJ", "CONVEYOR"], ["CNVGENINSTR", "CONVEYOR"], ["CNVSYNC", "CONVEYOR"], ["INDCNVINIT", "CONVEYOR"], ["INDCNVENABLE", "CONVEYOR"], ["INDCNVADDOBJECT", "CONVEYOR"], ["PRXSETPOSOFFSET", "SENSOR"], ["PRXACTIVRECORD", "SENSOR"], ["PRXACTIVANDSTORERECORD", "SENSOR"], ["PRXUSEFILERECORD", "SENSOR"], ["INDAMOVE", "INDEPENDENT"], ["INDCMOVE", "INDEPENDENT"], ["INDDMOVE", "INDEPENDENT"], ["INDRMOVE", "INDEPENDENT"], ["INDRESET", "INDEPENDENT"], ["MOVEEXTJ", "EXTERNAL"], ["SETLEADTHROUGH", "LEADTHROUGH"], ["WAITSENSOR", "SENSOR"], ["SYNCTOSENSOR", "SENSOR"], ["DROPSENSOR", "SENSOR"], ["FCACT", "FORCE"], ["FCPRESSLSTART", "FORCE"], ["FCPRESS1LSTART", "FORCE"], ["FCPRESSL", "FORCE"], ["FCPRESSC", "FORCE"], ["FCREFSTART", "FORCE"], ["FCREFSTOP", "FORCE"], ["FCPRESSEND", "FORCE"], ["FCDEACT", "FORCE"], ["EGMACTMOVE", "EGM"], ["EGMMOVEL", "EGM"], ["EGMMOVEC", "EGM"], ["EGMRUNJOINT", "EGM"], ["EGMRUNPOSE", "EGM"], ["EGMSTOP", "EGM"], ["EGMRESET", "EGM"], ["CONFL", "CONFL"], ["CONFJ", "CONFJ"], ["GRIPLOAD", STATED_LOAD]]);
let DISPLACES;
DISPLACES = py.sorted(py.sub(new Set([...py.iter(py.call(SWITCHES, "values"))]), new Set(["CONFL", "CONFJ", STATED_LOAD])));
let JOINTS_TOO;
JOINTS_TOO = ["CORR", "CSS", "EGM", "FORCE", "INDEPENDENT", "LEADTHROUGH", "SENSOR", "SOFT"];
let _ENDS_IT;
_ENDS_IT = ["PDISPOFF", "EOFFSOFF", "CORRCLEAR", "SOFTDEACT", "CSSDEACT", "SYNCMOVEOFF", "DROPWOBJ", "DROPSENSOR", "FCDEACT", "EGMRESET", "INDRESET"];
let READING;
READING = ["TPWRITE", "WRITE", "ERRWRITE", "ERRLOG", "UIMSGBOX", "SETSYSDATA", "GRIPLOAD"];
let BY_NAME;
BY_NAME = ["SETDATAVAL", "SETALLDATAVAL"];
function ends_displacement(statement) {
let first, has_off;
first = word(py.at(statement.items, 0));
if (py.same(first, "MOVEEXTJ")) {
return _moves_back(statement);
}
has_off = py.has(["SINGAREA", "SETLEADTHROUGH"], first);
return py.either(py.has(_ENDS_IT, first), () => py.both(has_off, () => py.has(words_in(statement.items), "OFF")));
return null;
}
function _moves_back(statement) {
let external, group, lists;
group = aggregate(py.at(split(py.text(statement.items).slice(1, undefined)), 0), "[");
lists = (((group) ?? null) === (null) ? null : (() => { const $out = []; for (const part of py.iter(group.parts)) { $out.push(aggregate(part, "[")); } return $out; })());
external = (py.truth(py.either(!py.truth(lists), () => ((py.at(lists, -1)) ?? null) === (null))) ? null : numbers_of(py.at(lists, -1).parts));
return py.both(((external) ?? null) !== (null), () => are_at_rest(external));
return null;
}
function are_at_rest(external) {
return py.all((() => { const $out = []; for (const number of py.iter(external)) { $out.push(py.either(py.same(number.value, 0.0), () => (number.value >= _NONE))); } return $out; })());
return null;
}
function code_of(source) {
let parts;
parts = (() => { const $out = []; for (const whole of py.iter(source.statements(_TOKENS, _WORDS))) { for (const part of py.iter(_divided(whole))) { $out.push(part); } } return $out; })();
return new Code(source, (() => { const $out = []; for (const [statement, ] of py.iter(parts)) { $out.push(statement); } return $out; })(), (() => { const $out = []; for (const [, step] of py.iter(parts)) { $out.push(step); } return $out; })());
return null;
}
function* _divided(whole) {
let end, first, is_label, items, k, size, statement;
items = whole.items;
k = 0;
while ((k < py.len(items))) {
first = word(py.at(items, k));
size = _size_of_head(items, k);
if (py.truth(py.both(py.same(first, "IF"), () => !py.truth(size)))) {
(yield* py.iter(_once(whole, py.text(items).slice(k, undefined))));
return null;
}
end = (py.truth(size) ? py.min(py.add(k, size), py.len(items)) : py.len(items));
statement = _part(whole, py.text(items).slice(k, end));
is_label = py.both(_is_label(items, k), () => !py.has(_HEADS, first));
(yield [statement, _step(statement, _opening(items, k), is_label)]);
k = end;
}
}
function _opening(items, k) {
let first;
first = word(py.at(items, k));
return (py.truth(py.both(py.same(first, "LOCAL"), () => (py.add(k, 1) < py.len(items)))) ? word(py.at(items, py.add(k, 1))) : first);
return null;
}
function _is_label(items, k) {
return py.both((py.add(k, 1) < py.len(items)), () => is_token(py.at(items, py.add(k, 1)), "SIGN", ":"));
return null;
}
function _size_of_head(items, k) {
let first, has_brackets, opening, size;
first = word(py.at(items, k));
opening = _opening(items, k);
size = 0;
if (py.has(_ALONE, first)) {
size = 1;
} else {
if (py.truth(py.either(py.has(_ROUTINES, opening), () => py.has(["MODULE", "RECORD"], opening)))) {
size = py.add((py.same(first, "LOCAL") ? 1 : 0), (py.same(opening, "FUNC") ? 3 : 2));
} else {
if (py.has(_HEADS, first)) {
size = py.add(_distance(items, k, [py.at(_HEADS, first)]), 1);
} else {
if (py.truth(py.both(first, () => _is_label(items, k)))) {
size = 2;
} else {
if (py.same(first, "TEST")) {
size = py.max(_distance(items, k, ["CASE", "DEFAULT"]), 0);
} else {
if (!py.truth(first)) {
size = py.max(py.add(_distance(items, py.add(k, 1), ["MODULE"]), 1), 0);
}
}
}
}
}
}
has_brackets = py.both(size, () => py.both((py.add(k, size) < py.len(items)), () => py.isinstance(py.at(items, py.add(k, size)), [Brackets])));
return (py.truth(py.both(has_brackets, () => py.either(py.has(_BLOCKS, opening), () => py.same(first, "ERROR")))) ? py.add(size, 1) : size);
return null;
}
function _distance(items, k, words) {
let j;
for (const $each of py.iter(py.range(k, py.len(items)))) {
j = $each;
if (py.truth(py.either(py.has(words, word(py.at(items, j))), () => py.both(is_token(py.at(items, j), "SIGN"), () => py.has(words, py.str(py.at(items, j))))))) {
return py.sub(j, k);
}
}
return -1;
return null;
}
function* _once(whole, items) {
let condition, k, motions, own, sides, statement;
own = [MOTIONS, SWITCHES, BY_NAME, _LEAVING];
motions = (() => { const $out = []; for (const k of py.iter(py.range(1, py.len(items)))) { if (py.truth(py.any((() => { const $out = []; for (const words of py.iter(own)) { $out.push(py.has(words, word(py.at(items, k)))); } return $out; })()))) $out.push(k); } return $out; })();
k = (py.truth(motions) ? py.at(motions, -1) : 1);
sides = split(items, ":=");
if (py.truth(py.both(!py.truth(motions), () => py.both(py.same(py.len(sides), 2), () => is_assignment(items))))) {
k = py.sub(py.len(py.at(sides, 0)), 1);
while (py.truth(py.both((k > 1), () => py.either(py.isinstance(py.at(items, k), [Brackets]), () => py.either(is_token(py.at(items, k), "SIGN", "."), () => is_token(py.at(items, py.sub(k, 1)), "SIGN", ".")))))) {
k = py.sub(k, 1);
}
}
condition = _part(whole, py.text(items).slice(undefined, 1));
(yield [condition, new Step(ONCE, undefined, undefined, undefined, undefined, undefined, undefined, undefined, _routines((() => { const $out = []; for (const [name, ] of py.iter(calls_in(py.text(items).slice(undefined, k)))) { $out.push(name); } return $out; })()))]);
if ((k < py.len(items))) {
statement = _part(whole, py.text(items).slice(k, undefined));
(yield [statement, _step(statement, word(py.at(statement.items, 0)), false)]);
}
(yield [condition, new Step(undefined, [ONCE])]);
}
function _part(whole, items) {
let line;
line = (py.truth(py.isinstance(py.at(items, 0), [Brackets])) ? whole.line : py.at(items, 0).line);
return new Statement(py.tuple(items), ...py.iter(place_of(items)), line);
return null;
}
function _step(statement, opening, is_label) {
let calls, first, is_own, items, names;
items = statement.items;
first = word(py.at(statement.items, 0));
if (py.has(_BLOCKS, opening)) {
names = (() => { const $out = []; for (const item of py.iter(items)) { if (py.truth(word(item))) $out.push(word(item)); } return $out; })();
return new Step(opening, undefined, (py.has(_ROUTINES, opening) ? py.at(names, -1) : ""), py.has(_LOOPS, opening), undefined, undefined, undefined, undefined, (py.has(_CONDITIONS, first) ? _routines((() => { const $out = []; for (const [name, ] of py.iter(calls_in(items))) { $out.push(name); } return $out; })()) : []));
}
if (py.has(_CLOSES, first)) {
return new Step(undefined, py.at(_CLOSES, first));
}
if (py.truth(py.either(py.has(_JUMPS, first), () => is_label))) {
calls = _routines((() => { const $out = []; for (const [name, ] of py.iter(calls_in(items))) { $out.push(name); } return $out; })());
return new Step(undefined, undefined, undefined, undefined, true, py.either(is_label, () => py.has(_HANDLERS, first)), undefined, undefined, calls);
}
if (py.same(first, "CONNECT")) {
return new Step(undefined, undefined, undefined, undefined, undefined, undefined, undefined, undefined, undefined, py.tuple(words_in(py.text(items).slice(1, undefined))));
}
is_own = !py.truth(py.either(is_assignment(items), () => py.either(py.has(MOTIONS, first), () => py.has(_STORAGE, first))));
names = (() => { const $out = []; for (const [name, ] of py.iter(calls_in(items))) { if (py.truth(py.either(is_own, () => !py.same(py.call(name, "upper"), first)))) $out.push(name); } return $out; })();
calls = _routines([...py.iter((py.truth(is_own) ? [first] : [])), ...py.iter(names), ...py.iter(_called_by_text(items))]);
return new Step(undefined, undefined, undefined, undefined, undefined, undefined, (py.has(SWITCHES, first) ? py.frozenset(new Set([py.at(SWITCHES, first)])) : py.frozenset()), undefined, calls);
return null;
}
function _routines(names) {
return py.tuple((() => { const $out = []; for (const name of py.iter(names)) { if (py.truth(py.both(name, () => py.both(!py.has(_INSTRUCTIONS, py.call(name, "upper")), () => py.both(!py.has(RAPID_FUNCTIONS, py.call(name, "upper")), () => py.both(!py.has(_FILLERS, py.call(name, "upper")), () => !py.has(SWITCHES, py.call(name, "upper")))))))) $out.push(py.call(name, "upper")); } return $out; })());
return null;
}
function _called_by_text(items) {
let texts;
texts = py.text(split(items, "%")).slice(1, 2);
if (py.truth(py.both(py.has(MOTIONS, word(py.at(items, 0))), () => py.call(word(py.at(items, 0)), "endswith", "SYNC")))) {
py.call(texts, "append", py.at(split(items), -1));
}
return (() => { const $out = []; for (const text of py.iter(texts)) { $out.push((py.truth(py.both(py.same(py.len(text), 1), () => is_token(py.at(text, 0), "TEXT"))) ? py.call(py.call(py.str(py.at(text, 0)), "strip", "\""), "upper") : "%")); } return $out; })();
return null;
}
function is_assignment(items) {
let signs;
signs = (() => { const $out = []; for (const item of py.iter(items)) { if (py.truth(is_token(item, "SIGN", ":=", "\\"))) $out.push(py.str(item)); } return $out; })();
return py.same(py.text(signs).slice(undefined, 1), [":="]);
return null;
}
function check_blocks(code) {
let found, is_outside, known, source, statement, step, where;
source = code.source;
if (!py.truth(py.any((() => { const $out = []; for (const step of py.iter(code.steps)) { $out.push(py.same(step.opens, "MODULE")); } return $out; })()))) {
throw source.error(py.add("the end of the file, expected ", _WORDS), py.len(source.content));
}
for (const $each of py.iter(py.zip(code.statements, code.steps, code.flow))) {
[statement, step, known] = $each;
found = text_of_items(py.text(statement.items).slice(undefined, 1));
is_outside = py.same(known.depth, 0);
if (py.truth(py.both(!py.same(py.same(step.opens, "MODULE"), is_outside), () => !py.truth(py.both(is_outside, () => py.same(found, "%")))))) {
where = (py.truth(is_outside) ? "outside of" : "within");
throw source.error((py.repr(found) + " " + py.str(where) + " a module; expected " + py.str(_WORDS)), statement.start);
}
if (py.truth(py.both(step.routine, () => !py.same(known.depth, 1)))) {
throw source.error((py.repr(found) + " within another routine; expected " + py.str(_WORDS)), statement.start);
}
}
return null;
}
return { _TOKENS, GRAMMAR, _WORDS, _ROUTINES, _LOOPS, _BLOCKS, _CLOSES, _HEADS, _JUMPS, _ALONE, _CONDITIONS, _LEAVING, _HANDLERS, _NONE, ONCE, _STORAGE, _PLAIN, OF_OPTIONS, MOTIONS, _MANUAL, RAPID_WORDS, _INSTRUCTIONS, RAPID_FUNCTIONS, _FILLERS, MOTION_OPTIONS, SWITCHES, DISPLACES, JOINTS_TOO, _ENDS_IT, READING, BY_NAME, ends_displacement, _moves_back, are_at_rest, code_of, _divided, _opening, _is_label, _size_of_head, _distance, _once, _part, _step, _routines, _called_by_text, is_assignment, check_blocks };
})();
MODULES.fanuc_ls = (() => {
const { Draft, joined } = MODULES.draft;
const { COMPUTED, LISTING_WORDS, SWITCHED, effect_in_listing, effect_of_options, number_in_brackets, why_moved_by_options } = MODULES.fanuc_lines;
const { ControllerLanguage } = MODULES.language;
const { STATED_LOAD, Line, Listing, reasons_before, with_outside } = MODULES.line_flow;
const { Frame, Load, Motion, Path, Point, Posture, Program, Skipped, Turn } = MODULES.program;
const { Statement, number_at } = MODULES.syntax;
let _LINES;
_LINES = "\nstart: _NL* PROG _NL (HEAD? _NL)* MN _NL (line? _NL)* POS _NL (BODY? _NL)* END (_NL | _EOT)*\nline: LINE_NUMBER? KIND PLACE REST? -\u003e motion\n    | LINE_NUMBER? PLACE REST?      -\u003e more\n    | LINE_NUMBER? OTHER            -\u003e other\n    | LINE_NUMBER                   -\u003e other\nPROG.5: /\\/PROG[^\\r\\n]*/\nMN.5: /\\/MN(?![^\\s])/\nPOS.5: /\\/POS(?![^\\s])/\nEND.5: /\\/END(?![^\\s])/\nLINE_NUMBER.4: /\\d*:/\nKIND.3: /[JLCA](?=[ \\t]*PR?\\[)/\nPLACE.2: /PR?\\[[^\\]\\r\\n]*\\]/\nREST: /[^\\s\\x04][^\\r\\n\\x04]*/\nOTHER: /([^\\s\\/\\x04]|\\/\\/)[^\\r\\n\\x04]*/\nHEAD: /[^\\s\\x04][^\\r\\n\\x04]*/\nBODY: /[^\\s\\x04\\/][^\\r\\n\\x04]*/\n_NL: /\\r\\n|\\r|\\n/\n_EOT: \"\\x04\"\n%ignore /[ \\t\\f\\xa0]+/\n";
let _POSITIONS;
_POSITIONS = "\nstart: block* \"\\x04\"\nblock: PLACE \"{\" group+ \"}\" \";\"\ngroup: GROUP \"UF\" \":\" FRAME \",\" \"UT\" \":\" FRAME \",\" (configuration \",\")? value (\",\" value)*\nconfiguration: \"CONFIG\" \":\" \"'\" SIDE+ \",\" TURN \",\" TURN \",\" TURN \"'\"\nvalue: NAME \"=\" SIGNED UNIT\nPLACE: /P\\[[^\\]\\r\\n]*\\]/\nGROUP: /GP\\d+:/\nFRAME: /F|\\d+/\nSIDE: /[NFUDTBLR](?![A-Z])/\nTURN: /[+-]?\\d+/\nNAME: /J\\d+|E\\d+|[XYZWPR]/\nSIGNED: /[+-]?(\\d+(\\.\\d*)?|\\.\\d+)|\\*+/\nUNIT: \"mm\" | \"deg\"\n%ignore /[ \\t\\f\\xa0\\r\\n]+/\n";
let _WORDS;
_WORDS = "a FANUC listing: /PROG, /MN with motions, /POS with positions, /END";
let _JUMPS;
_JUMPS = ["LBL", "JMP", "IF", "ELSE", "SELECT", "FOR", "CALL", "END", "SKIP"];
let _PATHS;
_PATHS = new py.Dict([["J", "joint"], ["L", "line"]]);
class _Instruction {
constructor(number = null, kind = null, places = null, texts = null, is_assignment = false) {
this.number = number;
this.kind = kind;
this.places = places;
this.texts = texts;
this.is_assignment = is_assignment;
}
get text() {
return py.call(" ", "join", (() => { const $out = []; for (const text of py.iter(this.texts)) { if (py.truth(text)) $out.push(text); } return $out; })());
return null;
}
get is_half_an_arc() {
return py.both(py.same(this.kind, "C"), () => py.both(py.same(py.len(this.places), 1), () => !py.truth(py.any(this.texts))));
return null;
}
take(more) {
if (py.same(this.kind, "C")) {
this.places = py.add(this.places, more.places);
}
this.texts = py.add(this.texts, more.texts);
return null;
}
get effect() {
if (py.truth(this.is_assignment)) {
return new Line(this.number);
}
if (py.truth(this.places)) {
return effect_of_options(this.text, this.number);
}
return effect_in_listing(this.text, this.number);
return null;
}
}
py.cached(_Instruction.prototype, "text");
class FanucLs extends ControllerLanguage {
read(sources) {
let _, begin, block, displaced, draft, drafts, end, groups, i, instructions, line, lines, listings, name, parts, place, point, source, title;
drafts = [];
parts = [];
for (const $each of py.iter(py.enumerate(sources))) {
[i, source] = $each;
draft = new Draft(sources, true);
draft.frame("0", np.eye(4), ["tool", "base"]);
lines = source.parse(_LINES, _WORDS).children;
begin = py.next((() => { const $out = []; for (const token of py.iter(lines)) { if (py.same(py.getattr(token, "type", ""), "POS")) $out.push(token); } return $out; })()).end_pos;
end = py.next((() => { const $out = []; for (const token of py.iter(lines)) { if (py.same(py.getattr(token, "type", ""), "END")) $out.push(token); } return $out; })()).start_pos;
for (const $each of py.iter(source.parse(_POSITIONS, _WORDS, [begin, end]).children)) {
block = $each;
[place, ...groups] = [...py.iter(block.children)];
name = _place(py.str(place));
line = py.at(source.place(place.start_pos), 0);
point = this._point(i, name, line, py.at(groups, 0).children);
draft.take((py.truth(py.isinstance(point, ["str"])) ? new Skipped(name, i, line, point) : point));
}
title = py.str(py.next((() => { const $out = []; for (const token of py.iter(lines)) { if (py.same(py.getattr(token, "type", ""), "PROG")) $out.push(token); } return $out; })()));
py.call(drafts, "append", draft);
py.call(parts, "append", [py.text(py.call(py.call(title, "upper"), "split")).slice(1, undefined), _instructions(lines)]);
}
listings = (() => { const $out = []; for (const [title, instructions] of py.iter(parts)) { $out.push(new Listing((py.truth(title) ? py.at(title, 0) : ""), (() => { const $out = []; for (const one of py.iter(instructions)) { $out.push(one.effect); } return $out; })())); } return $out; })();
displaced = reasons_before(with_outside(listings, SWITCHED));
for (const $each of py.iter(py.enumerate(py.zip(drafts, parts)))) {
[i, [draft, [, instructions]]] = $each;
this._move(draft, i, instructions, py.at(displaced, i));
draft.leave_unused(py.at(listings, i).lines);
}
return joined((() => { const $out = []; for (const draft of py.iter(drafts)) { $out.push(draft.finish()); } return $out; })());
return null;
}
_point(i, name, line, group) {
let keys, known, label, numbers, numbers_in_order, posture, rest, sides, tool, user, values;
[label, user, tool, ...rest] = [...py.iter(group)];
if (!py.same(label, "GP1:")) {
return "it has no group 1";
}
values = new py.Dict((() => { const $out = []; for (const tree of py.iter(rest)) { if (py.same(tree.data, "value")) $out.push([py.str(py.at(tree.children, 0)), py.text(tree.children).slice(1, undefined)]); } return $out; })());
numbers = new py.Dict((() => { const $out = []; for (const [key, [number, ]] of py.iter(py.call(values, "items"))) { $out.push([key, number_at(number)]); } return $out; })());
if (py.truth(py.any((() => { const $out = []; for (const number of py.iter(py.call(numbers, "values"))) { $out.push(((number) ?? null) === (null)); } return $out; })()))) {
return "it is not taught";
}
known = new py.Dict((() => { const $out = []; for (const [key, number] of py.iter(py.call(numbers, "items"))) { if (((number) ?? null) !== (null)) $out.push([key, number]); } return $out; })());
if (py.truth(py.any((() => { const $out = []; for (const [key, number] of py.iter(py.call(known, "items"))) { if (py.truth(py.call(key, "startswith", "E"))) $out.push(number.value); } return $out; })()))) {
return "an external axis is not at 0";
}
keys = (() => { const $out = []; for (const key of py.iter(known)) { if (!py.truth(py.call(key, "startswith", "E"))) $out.push(key); } return $out; })();
if (py.same(keys, py.list("XYZWPR"))) {
sides = (() => { const $out = []; for (const tree of py.iter(rest)) { if (py.same(tree.data, "configuration")) $out.push(tree); } return $out; })();
posture = (py.truth(sides) ? _posture(py.at(sides, 0).children) : new Posture());
numbers_in_order = py.tuple((() => { const $out = []; for (const key of py.iter(keys)) { $out.push(py.at(known, key)); } return $out; })());
return new Point(name, i, line, "pose", numbers_in_order, posture, new Frame(py.str(tool)), new Frame(py.str(user)));
}
if (py.same(keys, (() => { const $out = []; for (const k of py.iter(py.range(py.len(keys)))) { $out.push(("J" + py.str(py.add(k, 1)))); } return $out; })())) {
return new Point(name, i, line, "joints", py.tuple((() => { const $out = []; for (const key of py.iter(keys)) { $out.push(py.at(known, key)); } return $out; })()));
}
return "neither X Y Z W P R nor joints";
return null;
}
_move(draft, i, instructions, displaced) {
let _, load, names, number, one, path, place, reasons, run, span, statement, targets, text;
run = 0;
for (const $each of py.iter(py.zip(instructions, displaced))) {
[one, reasons] = $each;
names = (() => { const $out = []; for (const place of py.iter(one.places)) { $out.push(_place(py.str(place))); } return $out; })();
if (!py.truth(names)) {
draft.read(_places_in(py.call(one.text, "upper")));
run = py.add(run, py.call(py.call(one.text, "upper"), "startswith", _JUMPS));
continue;
}
if (py.truth(one.is_assignment)) {
draft.write(py.at(names, 0), ("line " + py.str(one.number) + " sets it while the program runs"));
draft.read(_places_in(one.text));
continue;
}
draft.read(py.sub(py.set(_places_in(one.text)), py.set(names)));
if (!py.truth(one.kind)) {
continue;
}
targets = (() => { const $out = []; for (const name of py.iter(names)) { $out.push(this._target(draft, i, name, one, reasons)); } return $out; })();
path = ((py.len(names) > 1) ? "circle" : py.call(_PATHS, "get", one.kind, "joint"));
place = py.at(one.places, -1);
span = [py.either(place.start_pos, () => 0), py.either(place.end_pos, () => 0)];
statement = new Statement([], ...py.iter(span), py.either(place.line, () => 0));
[number, , text] = [...py.iter(py.call(py.call(reasons, "get", STATED_LOAD, ""), "partition", " "))];
load = (py.truth(number) ? new Load(text, py.int(number)) : null);
py.call(draft.motions, "append", new Motion(path, py.tuple(targets), statement, i, undefined, undefined, span, run, undefined, undefined, load));
}
return null;
}
_target(draft, i, name, one, reasons) {
let moved, why;
if (py.truth(py.call(name, "startswith", "PR["))) {
return new Skipped(name, i, one.number, "a position register");
}
moved = why_moved_by_options(one.text, one.number);
if (py.truth(py.call(moved, "startswith", COMPUTED))) {
draft.read([name]);
return new Skipped(name, i, one.number, moved);
}
why = py.either(moved, () => draft.why_displaced(name, reasons));
if (py.truth(why)) {
draft.write(name, why);
}
return name;
return null;
}
}
FanucLs.prototype.name = "FANUC LS";
FanucLs.prototype.suffixes = [".ls"];
FanucLs.prototype.grammars = [_LINES, _POSITIONS];
FanucLs.prototype.understood = LISTING_WORDS;
LANGUAGES.register(FanucLs);
function _instructions(lines) {
let found, is_arc, is_more, line, one, parts, text;
found = py.list();
for (const $each of py.iter(lines)) {
line = $each;
if (!py.truth(py.hasattr(line, "data"))) {
continue;
}
parts = new py.Dict((() => { const $out = []; for (const token of py.iter(line.children)) { if (!py.truth(py.hasattr(token, "data"))) $out.push([token.type, token]); } return $out; })());
text = py.call(py.str(py.call(parts, "get", "REST", py.call(parts, "get", "OTHER", ""))), "lstrip", "] ");
if (py.truth(py.both(py.same(line.data, "other"), () => py.call(text, "startswith", ["!", "//", "--"])))) {
continue;
}
one = _instruction(line.data, parts, text);
is_more = py.same(py.str(py.call(parts, "get", "LINE_NUMBER", "")), ":");
is_arc = py.both(py.same(line.data, "more"), () => !py.truth(one.is_assignment));
if (py.truth(py.both(found, () => py.either(is_more, () => py.both(is_arc, () => py.at(found, -1).is_half_an_arc))))) {
py.at(found, -1).take(one);
} else {
py.call(found, "append", one);
}
}
return found;
return null;
}
function _instruction(data, parts, text) {
let is_assignment, number, place, places;
place = py.call(parts, "get", "PLACE");
number = py.either(py.next((() => { const $out = []; for (const token of py.iter(py.call(parts, "values"))) { $out.push(token); } return $out; })()).line, () => 0);
text = py.call((!py.has(text, "(") ? py.at(py.call(text, "partition", " !"), 0) : text), "rstrip", "; ");
is_assignment = py.both(py.same(data, "more"), () => py.call(text, "startswith", "="));
places = (((place) ?? null) !== (null) ? [place] : []);
return new _Instruction(number, py.str(py.call(parts, "get", "KIND", "")), places, [text], is_assignment);
return null;
}
function _place(text) {
let _, index, kind, number;
[kind, , index] = [...py.iter(py.call(text, "partition", "["))];
number = number_in_brackets(py.call(index, "removesuffix", "]"));
return (py.str(kind) + "[" + py.str((py.truth(py.call(number, "isdigit")) ? number : "*")) + "]");
return null;
}
function* _places_in(text) {
let k, pieces;
pieces = py.call(text, "split", "P[");
for (const $each of py.iter(py.range(1, py.len(pieces)))) {
k = $each;
if (!py.truth(py.call(py.text(py.at(pieces, py.sub(k, 1))).slice(-1, undefined), "isalpha"))) {
(yield _place(py.add(py.add("P[", py.at(py.call(py.at(pieces, k), "split", "]"), 0)), "]")));
}
}
}
function _posture(configuration) {
let counted, number, sides, turns;
sides = new Set((() => { const $out = []; for (const token of py.iter(configuration)) { if (py.same(token.type, "SIDE")) $out.push(py.str(token)); } return $out; })());
turns = (() => { const $out = []; for (const token of py.iter(configuration)) { if (py.truth(py.both(py.same(token.type, "TURN"), () => (((number = number_at(token))) ?? null) !== (null)))) $out.push(number); } return $out; })();
counted = py.tuple((() => { const $out = []; for (const [j, number] of py.iter(py.zip([0, 3, 5], turns))) { $out.push(new Turn(j, "whole", py.int(number.value), number)); } return $out; })());
return new Posture(_side(sides, "T", "B"), _side(sides, "U", "D"), _side(sides, "N", "F"), counted);
return null;
}
function _side(sides, yes, no) {
return (py.same(py.has(sides, yes), py.has(sides, no)) ? null : py.has(sides, yes));
return null;
}
return { _LINES, _POSITIONS, _WORDS, _JUMPS, _PATHS, _Instruction, FanucLs, _instructions, _instruction, _place, _places_in, _posture, _side };
})();
MODULES.jbi = (() => {
const { Draft, joined } = MODULES.draft;
const { JOB_WORDS, SHIFT, effect_in_job, named_in, why_not_reached } = MODULES.jbi_lines;
const { ControllerLanguage } = MODULES.language;
const { Line, Listing, reasons_before, with_outside } = MODULES.line_flow;
const { Frame, Motion, Path, Point, Posture, Program, Skipped, Turn, counted_axes } = MODULES.program;
const { Number, Statement, number_at } = MODULES.syntax;
let _GRAMMAR;
_GRAMMAR = "\nstart: (COMMENT? _NL)* JOB _NL (_head? _NL)* INST _NL (_line? _NL)* (_line? _EOT)\n_head: tag | configuration | position | COMMENT\ntag: TAG REST?\nconfiguration: RCONF SIGNED (\",\" SIGNED)*\nposition: PLACE \"=\" SIGNED (\",\" SIGNED)*\n_line: motion | other | COMMENT\nmotion: MOVE PLACE REST?\nother: OTHER\nJOB.5: /\\/JOB(?![^\\s])/\nINST.5: /\\/\\/INST(?![^\\s])/\nRCONF.4: /\\/\\/\\/RCONF/\nTAG.3: /\\/{2,3}[A-Z][A-Z0-9]*/\nMOVE.3: /(MOV[JLCS]|IMOV)(?![A-Z0-9])/\nPLACE.3: /(BC|EC|BP|EX|C|P)\\d+|P\\[[^\\]\\r\\n]*\\]/\nSIGNED: /[+-]?(\\d+(\\.\\d*)?|\\.\\d+)/\nREST: /[^\\s\\x04'][^\\r\\n\\x04]*/\nOTHER: /[^\\s\\x04'][^\\r\\n\\x04]*/\nCOMMENT.4: /'[^\\r\\n]*/\n_NL: /\\r\\n|\\r|\\n/\n_EOT: \"\\x04\"\n%ignore /[ \\t\\f\\xa0]+/\n";
let _WORDS;
_WORDS = "a job: /JOB, //POS with positions, //INST with motions, END";
let _PATHS;
_PATHS = new py.Dict([["MOVL", "line"], ["MOVJ", "joint"], ["MOVS", "joint"], ["MOVC", "joint"]]);
let _ANY_POSTURE;
_ANY_POSTURE = new Posture();
let _JUMPS;
_JUMPS = ["*", "JUMP", "CALL", "IF", "ELSE", "ENDIF", "FOR", "NEXT", "WHILE", "ENDWHILE", "RET", "PSTART"];
class Jbi extends ControllerLanguage {
constructor(pulses = null) {
super();
this.pulses = pulses;
}
with_pulses(text) {
let found;
try {
found = py.tuple((() => { const $out = []; for (const word of py.iter(py.call(py.call(text, "replace", ",", " "), "split"))) { $out.push(py.float(word)); } return $out; })());
} catch ($error) { if (!($error instanceof py.ValueError)) throw $error;
found = [];
}
if (py.truth(py.either(!py.truth(found), () => !py.truth(py.all((() => { const $out = []; for (const number of py.iter(found)) { $out.push(py.both(math.isfinite(number), () => !py.same(number, 0.0))); } return $out; })()))))) {
throw new BadInputError(("pulses " + py.repr(text) + "; expected pulses per degree, one number per axis, none of them 0"));
}
return new Jbi(found);
return null;
}
refusal(point) {
if (py.truth(py.both(py.same(point.kind, "joints"), () => ((this.pulses) ?? null) === (null)))) {
return "it is in pulses: give the pulses per degree (--pulses)";
}
if (py.truth(py.both(py.same(point.kind, "joints"), () => !py.same(py.len(py.either(this.pulses, () => [])), py.len(point.numbers))))) {
return (py.str(counted_axes(py.len(point.numbers))) + ", but --pulses has " + py.str(py.len(py.either(this.pulses, () => []))));
}
return "";
return null;
}
read(sources) {
let displaced, draft, drafts, i, jobs, other, others, parts, source, tree, trees;
drafts = [];
trees = [];
for (const $each of py.iter(py.enumerate(sources))) {
[i, source] = $each;
draft = new Draft(sources, true);
tree = source.parse(_GRAMMAR, _WORDS);
parts = (() => { const $out = []; for (const part of py.iter(tree.children)) { if (py.truth(py.hasattr(part, "data"))) $out.push(part); } return $out; })();
others = (() => { const $out = []; for (const part of py.iter(parts)) { if (py.same(part.data, "other")) $out.push(py.call(py.str(py.at(part.children, 0)), "split")); } return $out; })();
if (py.truth(py.either(!py.truth(others), () => !py.same(py.text(py.at(others, -1)).slice(undefined, 1), ["END"])))) {
throw source.error("the end of the file without END: is it truncated?", py.len(source.content));
}
this._positions(draft, i, source, parts);
py.call(drafts, "append", draft);
py.call(trees, "append", parts);
}
jobs = (() => { const $out = []; for (const parts of py.iter(trees)) { $out.push(_listing(parts)); } return $out; })();
displaced = reasons_before(with_outside(jobs, [SHIFT]), [SHIFT]);
for (const $each of py.iter(py.enumerate(py.zip(drafts, trees)))) {
[i, [draft, parts]] = $each;
this._motions(draft, i, parts, py.at(displaced, i));
for (const $each of py.iter(trees)) {
other = $each;
_note_changes(draft, other, ((other) ?? null) !== (parts));
}
draft.leave_unused(py.at(jobs, i).lines);
}
return joined((() => { const $out = []; for (const draft of py.iter(drafts)) { $out.push(draft.finish()); } return $out; })());
return null;
}
_positions(draft, i, source, parts) {
let counts, expected, head, part, seen;
head = new _Head();
seen = 0;
for (const $each of py.iter(parts)) {
part = $each;
head.take(part);
if (py.same(part.data, "position")) {
seen = py.add(seen, 1);
_note_position(draft, i, part, head);
}
}
counts = (() => { const $out = []; for (const text of py.iter(py.call(py.call(head.tags, "get", "NPOS", py.str(seen)), "split", ","))) { $out.push(py.call(text, "strip")); } return $out; })();
expected = py.sum((() => { const $out = []; for (const text of py.iter(counts)) { if (py.truth(py.call(text, "isdigit"))) $out.push(py.int(text)); } return $out; })());
if (!py.same(seen, expected)) {
throw source.error((py.str(seen) + " position" + py.str((py.same(seen, 1) ? "" : "s")) + "; expected the " + py.str(expected) + " of ///NPOS"), 0);
}
return null;
}
_motions(draft, i, parts, displaced) {
let arc, kind, name, part, path, place, reasons, run, span, target, targets, via;
run = 0;
arc = 0;
via = "";
for (const $each of py.iter(py.zip(_instructions(parts), displaced))) {
[part, reasons] = $each;
if (!py.same(part.data, "motion")) {
run = py.add(run, py.call(py.call(py.str(py.at(part.children, 0)), "upper"), "startswith", _JUMPS));
continue;
}
kind = py.str(py.at(part.children, 0));
name = _name(py.str(py.at(part.children, 1)));
target = _target(draft, i, part, reasons);
arc = (py.same(kind, "MOVC") ? py.add(arc, 1) : 0);
if (py.same(arc, 2)) {
via = name;
continue;
}
path = py.call(_PATHS, "get", kind, "joint");
targets = [target];
if (py.same(arc, 1)) {
path = "line";
} else {
if (py.same(arc, 3)) {
path = "circle";
targets = [via, target];
}
}
place = py.at(part.children, 1);
span = [place.start_pos, place.end_pos];
py.call(draft.motions, "append", new Motion(path, targets, new Statement([], ...py.iter(span), place.line), i, undefined, undefined, span, run));
}
return null;
}
}
Jbi.prototype.name = "JBI";
Jbi.prototype.suffixes = [".jbi"];
Jbi.prototype.grammars = [_GRAMMAR];
Jbi.prototype.digits = [4, 6, 0];
Jbi.prototype.understood = JOB_WORDS;
LANGUAGES.register(Jbi);
function _target(draft, i, part, reasons) {
let kind, line, name, why;
kind = py.str(py.at(part.children, 0));
line = py.at(part.children, 1).line;
name = _name(py.str(py.at(part.children, 1)));
if (py.same(kind, "IMOV")) {
draft.write(name, ("line " + py.str(line) + " moves by it (IMOV)"));
return new Skipped(name, i, line, "a relative motion");
}
if (py.has(name, "[")) {
return new Skipped(name, i, line, "a computed position");
}
why = _why_left(draft, name, part, reasons);
if (py.truth(why)) {
draft.write(name, why);
}
return name;
return null;
}
class _Head {
constructor(tags = new py.Dict([["TOOL", ""], ["USER", ""], ["POSTYPE", ""]]), posture = _ANY_POSTURE) {
this.tags = tags;
this.posture = posture;
}
take(part) {
let name, rest;
if (py.same(part.data, "tag")) {
[name, ...rest] = [...py.iter((() => { const $out = []; for (const child of py.iter(part.children)) { $out.push(py.str(child)); } return $out; })())];
py.put(this.tags, py.call(name, "lstrip", "/"), (py.truth(rest) ? py.call(py.at(rest, 0), "strip") : ""));
} else {
if (py.same(part.data, "configuration")) {
this.posture = _posture((() => { const $out = []; for (const token of py.iter(py.text(part.children).slice(1, undefined))) { $out.push(number_at(token)); } return $out; })());
}
}
return null;
}
point(i, place, numbers) {
let base, kind, name, tool, user;
name = _name(py.str(place));
kind = py.at(this.tags, "POSTYPE");
if (py.same(kind, "PULSE")) {
return new Point(name, i, place.line, "joints", numbers);
}
if (py.truth(py.either(!py.has(["BASE", "ROBOT", "USER"], kind), () => !py.has([6, 7], py.len(numbers))))) {
return ("positions of the type " + py.str(kind) + " are not supported");
}
if (py.truth(py.both(py.same(py.len(numbers), 7), () => py.at(numbers, 6).value))) {
return "its elbow angle is not 0";
}
user = new Frame(py.either(py.at(this.tags, "USER"), () => "USER"));
base = (py.same(kind, "USER") ? user : new Frame(kind, np.eye(4)));
tool = new Frame(py.either(py.at(this.tags, "TOOL"), () => "TOOL"));
return new Point(name, i, place.line, "pose", py.text(numbers).slice(undefined, 6), this.posture, tool, base);
return null;
}
}
function _note_position(draft, i, part, head) {
let found, name, numbers, place, point, values;
[place, ...values] = [...py.iter(part.children)];
name = _name(py.str(place));
found = (() => { const $out = []; for (const token of py.iter(values)) { $out.push(number_at(token)); } return $out; })();
numbers = py.tuple((() => { const $out = []; for (const number of py.iter(found)) { if (((number) ?? null) !== (null)) $out.push(number); } return $out; })());
if (py.truth(py.call(name, "startswith", ["BC", "EC", "BP", "EX"]))) {
py.put(draft.at_rest, name, py.all((() => { const $out = []; for (const number of py.iter(numbers)) { $out.push(py.same(number.value, 0.0)); } return $out; })()));
return null;
}
point = head.point(i, place, numbers);
draft.take((py.truth(py.isinstance(point, ["str"])) ? new Skipped(name, i, place.line, point) : point));
return null;
}
function _instructions(parts) {
return (() => { const $out = []; for (const part of py.iter(parts)) { if (py.has(["motion", "other"], part.data)) $out.push(part); } return $out; })();
return null;
}
function _listing(parts) {
let lines, names;
names = (() => { const $out = []; for (const part of py.iter(parts)) { if (py.truth(py.both(py.same(part.data, "tag"), () => py.both(py.same(py.str(py.at(part.children, 0)), "//NAME"), () => (py.len(part.children) > 1))))) $out.push(py.call(py.call(py.str(py.at(part.children, 1)), "strip"), "upper")); } return $out; })();
lines = (() => { const $out = []; for (const part of py.iter(_instructions(parts))) { $out.push((py.same(part.data, "other") ? effect_in_job(py.str(py.at(part.children, 0)), py.at(part.children, 0).line) : new Line(py.at(part.children, 0).line))); } return $out; })();
return new Listing((py.truth(names) ? py.at(names, 0) : ""), lines);
return null;
}
function _why_left(draft, name, part, reasons) {
let axis, line, options, rest;
options = ((py.len(part.children) > 2) ? py.str(py.at(part.children, 2)) : "");
line = py.at(part.children, 0).line;
for (const $each of py.iter(named_in(py.at(py.call(options, "partition", "+"), 0)))) {
axis = $each;
if (py.truth(py.call(axis, "startswith", "B"))) {
rest = py.call(draft.at_rest, "get", _name(axis), false);
if (!py.truth(rest)) {
return ("its base axis is not at 0 (" + py.str(axis) + ", line " + py.str(line) + ")");
}
}
}
return py.either(why_not_reached(options, line), () => draft.why_displaced(name, reasons));
return null;
}
function _note_changes(draft, parts, only_variables) {
let is_read, is_variable, name, names, part, text, token;
for (const $each of py.iter(_instructions(parts))) {
part = $each;
token = py.at(part.children, -1);
text = py.str(token);
if (py.same(part.data, "motion")) {
names = ((py.len(part.children) > 2) ? named_in(py.at(py.call(text, "partition", "+"), 2)) : []);
} else {
names = named_in(text);
}
for (const $each of py.iter(names)) {
name = $each;
is_variable = py.call(name, "startswith", "P");
is_read = py.both(py.same(part.data, "other"), () => py.call(py.call(text, "upper"), "startswith", "REFP"));
if (py.truth(py.both(py.either(is_variable, () => !py.truth(only_variables)), () => !py.truth(is_read)))) {
draft.write(_name(name), ("line " + py.str(token.line) + " may set it"));
}
}
}
return null;
}
function _name(text) {
let number;
number = py.call(text, "lstrip", "BCEPX");
return (py.truth(py.call(number, "isdigit")) ? (py.str(py.call(text, "removesuffix", number)) + py.str(py.call(number, "rjust", 5, "0"))) : text);
return null;
}
function _posture(values) {
let flags, numbers, turns;
numbers = (() => { const $out = []; for (const number of py.iter(values)) { if (((number) ?? null) !== (null)) $out.push(number); } return $out; })();
if (py.truth(py.either((py.len(numbers) < 6), () => py.any((() => { const $out = []; for (const number of py.iter(py.text(numbers).slice(undefined, 6))) { $out.push(!py.has([0.0, 1.0], number.value)); } return $out; })())))) {
return new Posture();
}
flags = (() => { const $out = []; for (const number of py.iter(numbers)) { $out.push(py.bool(number.value)); } return $out; })();
turns = py.tuple((() => { const $out = []; for (const [k, j] of py.iter([[3, 3], [4, 5], [5, 0]])) { $out.push(new Turn(j, "half", py.int(py.at(flags, k)), py.at(numbers, k))); } return $out; })());
return new Posture(!py.truth(py.at(flags, 2)), !py.truth(py.at(flags, 1)), py.at(flags, 0), turns);
return null;
}
return { _GRAMMAR, _WORDS, _PATHS, _ANY_POSTURE, _JUMPS, Jbi, _target, _Head, _note_position, _instructions, _listing, _why_left, _note_changes, _name, _posture };
})();
MODULES.krl = (() => {
const { Draft } = MODULES.draft;
const { OUTSIDE, Code, Step, followed } = MODULES.flow;
const { ControllerLanguage } = MODULES.language;
const { POSITIONS, STATED_LOAD } = MODULES.line_flow;
const { Frame, Load, Motion, Path, Point, Posture, Program, Skipped, Turn } = MODULES.program;
const { EXTERNAL, Entries, Reader } = MODULES.statement_reader;
const { Brackets, Number, Statement, aggregate, call_of, calls_in, element_name, is_token, nested, number_of, place_of, split, text_of_items, word } = MODULES.syntax;
const { Understood, understood_words } = MODULES.understood;
let _TOKENS;
_TOKENS = "\nTEXT: /\"[^\"\\r\\n]*\"/\nBITS.2: /'[BbHh][0-9A-Fa-f]+'/\nSIGN: /[=\u003c\u003e]=|[^\\x04\\s\\w()\\[\\]{}\"';&$#]|'/\n_END: /\\r\\n|\\r|\\n|\\x04/\nCOMMENT.5: /;[^\\r\\n]*/\nHEADER.5: /&[^\\r\\n]*/\n%ignore COMMENT\n%ignore HEADER\n%ignore /[ \\t\\f\\xa0]+/\n";
let _WORDS;
_WORDS = "KRL: statements within DEF ... END or DEFDAT ... ENDDAT, brackets closed on their line";
let _ROUTINES;
_ROUTINES = new py.Dict([["DEF", "END"], ["DEFFCT", "ENDFCT"], ["DEFDAT", "ENDDAT"]]);
let _LOOPS;
_LOOPS = new py.Dict([["LOOP", "ENDLOOP"], ["WHILE", "ENDWHILE"], ["FOR", "ENDFOR"], ["REPEAT", "UNTIL"]]);
let _BLOCKS;
_BLOCKS = new py.Dict([["IF", "ENDIF"], ["SWITCH", "ENDSWITCH"], ["SPLINE", "ENDSPLINE"], ["PTP_SPLINE", "ENDSPLINE"]]);
let _CLOSES;
_CLOSES = new py.Dict((() => { const $out = []; for (const end of py.iter(new Set([...py.iter(py.call(_ROUTINES, "values")), ...py.iter(py.call(_LOOPS, "values")), ...py.iter(py.call(_BLOCKS, "values"))]))) { $out.push([end, py.tuple((() => { const $out = []; for (const [k, v] of py.iter(py.call(new py.Dict([...py.iter(py.call(_ROUTINES, 'items')), ...py.iter(py.call(_LOOPS, 'items')), ...py.iter(py.call(_BLOCKS, 'items'))]), "items"))) { if (py.same(v, end)) $out.push(k); } return $out; })())]); } return $out; })());
let _MOTIONS;
_MOTIONS = new py.Dict([["PTP", "joint"], ["LIN", "line"], ["CIRC", "circle"], ["SPTP", "joint"], ["SLIN", "line"], ["SCIRC", "circle"], ["SPL", "joint"]]);
let _BY_POSTURE;
_BY_POSTURE = ["PTP", "SPTP"];
let _RELATIVE;
_RELATIVE = new Set((() => { const $out = []; for (const name of py.iter(_MOTIONS)) { $out.push((py.str(name) + "_REL")); } return $out; })());
let _AFTER;
_AFTER = new Set(["C_DIS", "C_VEL", "C_ORI", "C_PTP", "C_SPL", "WITH"]);
let _POSE;
_POSE = ["X", "Y", "Z", "A", "B", "C"];
let _JOINTS;
_JOINTS = ["A1", "A2", "A3", "A4", "A5", "A6"];
let _EXTERNAL;
_EXTERNAL = ["E1", "E2", "E3", "E4", "E5", "E6"];
let _NULL;
_NULL = ["$NULLFRAME", "$WORLD", "TOOL_DATA[0]", "BASE_DATA[0]"];
let _FRAMES;
_FRAMES = py.frozenset(new Set(["$TOOL", "$BASE"]));
let _BY_DATA;
_BY_DATA = ["#PTP_PARAMS", "#CP_PARAMS", "#FRAMES", "#PTP_DAT", "#CP_DAT"];
let _SPEEDS;
_SPEEDS = ["#VEL_PTP", "#VEL_CP", "#ACC_PTP", "#ACC_CP", "#OUT_SYNC"];
let _MANUAL;
_MANUAL = "KUKA System Software 8, operating and programming instructions for system integrators";
let _KRL_WORDS;
_KRL_WORDS = [new Understood("instruction", (py.str(_MANUAL) + ", chapter 11: program flow, declarations, interrupts, outputs"), "IF, ELSE, ENDIF, SWITCH, CASE, DEFAULT, ENDSWITCH, LOOP, ENDLOOP, FOR, ENDFOR, WHILE, ENDWHILE, REPEAT, UNTIL, EXIT, GOTO, HALT, WAIT, RETURN, RESUME, CONTINUE, BRAKE, DECL, SIGNAL, ENUM, STRUC, EXT, EXTFCT, IMPORT, GLOBAL, CONST, INT, REAL, BOOL, CHAR, POS, E3POS, E6POS, AXIS, E3AXIS, E6AXIS, FRAME, INTERRUPT, TRIGGER, PULSE, ANOUT, ANIN, DIGIN, INI, DEF, DEFFCT, DEFDAT, END, ENDFCT, ENDDAT, SPLINE, PTP_SPLINE, ENDSPLINE, TIME_BLOCK, CONST_VEL, STOP, CONFIRM, CCLOSE"), new Understood("function", (py.str(_MANUAL) + ", chapters 11 and 12: words before brackets, conditions, messages, data; frames that BAS sets are read from its arguments"), "IF, WHILE, UNTIL, FOR, WHEN, SWITCH, CASE, AND, OR, NOT, EXOR, B_AND, B_OR, B_NOT, B_EXOR, RETURN, WAIT, SEC, TO, STEP, DO, DEF, DEFFCT, EXT, EXTFCT, BAS, STOOL, STOOL2, SBASE, SIPO_MODE, SVEL_JOINT, SVEL_CP, SACC_JOINT, SACC_CP, SAPO, SAPO_PTP, SGEAR_JERK, SJERK, SORI_TYP, SLOAD, PATH, ABS, SQRT, SIN, COS, TAN, ACOS, ATAN2, INVERSE, FORWARD, INV_POS, VARSTATE, PULSE, SIGN, ROUND, STRLEN, STRDECLLEN, STRFIND, STRCOMP, MSGNOTIFY, MSGSTATE, MSGQUIT, MSGACKNOWLEDGE, MSGDIALOG, MSGLOOP, SET_KRLMSG, EXISTS_KRLMSG, CLEAR_KRLMSG, SET_KRLDLG, EXISTS_KRLDLG, IR_STOPM"), new Understood("function", "KUKA System Software 8.3 and later: collision detection, as their inline forms call it", "USE_CM_PRO_VALUES, SET_CD_PARAMS"), new Understood("filler", "KUKA, CREAD/CWRITE for KSS 8: texts and channels, which write to their arguments", "CAST_TO, CAST_FROM, SREAD, SWRITE, CREAD, CWRITE, COPEN, CCLOSE, CIOCTL, STRCLEAR, STRADD, STRCOPY"), new Understood("variable", "KUKA System Software 8, system variables: speeds, approximation, times, signals, start; $TOOL, $BASE, $ORI_TYPE and $LOAD are read", "$TOOL, $BASE, $ORI_TYPE, $LOAD, $IPO_MODE, $ADVANCE, $VEL, $ACC, $APO, $VEL_AXIS, $ACC_AXIS, $VEL_EXTAX, $ACC_EXTAX, $OV_PRO, $OV_ROB, $OV_APPL, $OUT, $OUT_C, $COLLMON_TOL_PRO, $ANOUT, $DIGOUT, $TIMER, $TIMER_STOP, $TIMER_FLAG, $FLAG, $CYCFLAG, $BWDSTART, $H_POS, $CIRC_TYPE, $GEAR_JERK, $JERK, $RED_VEL, $FILTER, $ERR, $LOOP_MSG, $LOOP_CONT, $MSG_T, $CP_VEL_TYPE, $SPL_VEL_MODE, $SPL_VEL_RESTR, $DECEL_MB, $ACC_MA, $ACC_CAR_LIMIT, $ACC_CAR_STOP, $PRO_IP, $TORQUE_DIFF, $SEN_PREA, $SEN_PINT, $TECHPAR, $LOAD_A1, $LOAD_A2, $LOAD_A3")];
let _INSTRUCTIONS;
_INSTRUCTIONS = understood_words(_KRL_WORDS, "instruction");
let _HARMLESS;
_HARMLESS = understood_words(_KRL_WORDS, "function");
let _FILLERS;
_FILLERS = understood_words(_KRL_WORDS, "filler");
let _VARIABLES;
_VARIABLES = understood_words(_KRL_WORDS, "variable");
let _TURNING;
_TURNING = ["#VAR", "#JOINT"];
let _ORIENTATION;
_ORIENTATION = "$ORI_TYPE";
let _ROBOT;
_ROBOT = "$ROBROOT";
let _PLACES;
_PLACES = ["$ROBROOT", "$ERSYSROOT", "$WORLD", "$ERSYS"];
let _SETTABLE;
_SETTABLE = ["$TOOL", "$BASE", "FDAT_ACT", "$ORI_TYPE", "LDAT_ACT", "$LOAD"];
class Krl extends ControllerLanguage {
read(sources) {
let code, data, draft, entries, files, harmless, k, reader, readers, source, statements;
draft = new Draft(sources);
files = [];
for (const $each of py.iter(sources)) {
source = $each;
statements = source.statements(_TOKENS, _WORDS);
py.call(files, "append", new Code(source, statements, (() => { const $out = []; for (const statement of py.iter(statements)) { $out.push(_step(statement)); } return $out; })()));
}
files = followed(files, _FRAMES);
for (const $each of py.iter(files)) {
code = $each;
_check_outside(code);
}
harmless = py.or(_HARMLESS, new Set((() => { const $out = []; for (const code of py.iter(files)) { for (const [statement, step] of py.iter(py.zip(code.statements, code.steps))) { if (py.truth(_takes_values(statement, step))) $out.push(step.routine); } } return $out; })()));
data = new _Data();
entries = new Entries(files, ((statement) => data.turns(statement)));
readers = (() => { const $out = []; for (const [i, code] of py.iter(py.enumerate(files))) { $out.push(new _SourceReader(draft, i, code, harmless, entries, this, data)); } return $out; })();
for (const $each of py.iter(readers)) {
reader = $each;
for (const $each of py.iter(py.range(py.len(reader.statements)))) {
k = $each;
reader.declare(k);
}
}
for (const $each of py.iter(readers)) {
reader = $each;
for (const $each of py.iter(py.range(py.len(reader.statements)))) {
k = $each;
reader.move(k);
}
}
return draft.finish();
return null;
}
statement(motion, source, values, posture) {
let after, approximate, end, numbers, pose, start;
[start, end] = [...py.iter(motion.span)];
numbers = [...py.iter(py.text(values).slice(undefined, 3)), ...py.iter((() => { const $out = []; for (const angle of py.iter(py.text(values).slice(3, undefined))) { $out.push(py.sub(angle, (360.0 * py.round((angle / 360.0))))); } return $out; })())];
pose = py.call(",", "join", (() => { const $out = []; for (const [name, value] of py.iter(py.zip(_POSE, numbers))) { $out.push((py.str(name) + " " + py.format(value, ("." + py.str((py.has("XYZ", name) ? 4 : 6)) + "f")))); } return $out; })());
after = py.text(source.text).slice(end, motion.statement.end);
approximate = (py.truth(py.either(py.any((() => { const $out = []; for (const word of py.iter(_AFTER)) { $out.push(py.has(py.call(after, "upper"), word)); } return $out; })()), () => py.call(after, "strip"))) ? "" : " C_DIS");
return py.add(py.add(py.add(py.add(py.add(py.text(source.text).slice(motion.statement.start, start), "{"), pose), "}"), after), approximate);
return null;
}
bits(number, value) {
let text;
if (!py.truth(py.call(number.text, "startswith", "'"))) {
return py.str(value);
}
text = (py.has("Bb", py.at(number.text, 1)) ? (py.format(value, ("b"))) : (py.format(value, ("X"))));
return ("'" + py.str(py.at(number.text, 1)) + py.str(py.call(text, "rjust", py.sub(py.len(number.text), 3), "0")) + "'");
return null;
}
}
Krl.prototype.name = "KRL";
Krl.prototype.suffixes = [".src", ".dat"];
Krl.prototype.is_pair = true;
Krl.prototype.reads_others = true;
Krl.prototype.convention = "kuka";
Krl.prototype.can_insert = true;
Krl.prototype.grammars = [nested(_TOKENS)];
Krl.prototype.understood = _KRL_WORDS;
LANGUAGES.register(Krl);
class _Data {
constructor(frames = py.dict(), is_fixed = false, constant = py.set()) {
this.frames = frames;
this.is_fixed = is_fixed;
this.constant = constant;
}
tool_is_fixed() {
this.is_fixed = true;
return null;
}
turns(statement) {
let sides;
if (py.truth(_by_bas(statement.items))) {
return true;
}
sides = split(statement.items, "=");
if (!py.same(py.len(sides), 2)) {
return false;
}
if (py.same(text_of_items(py.at(sides, 0)), "LDAT_ACT")) {
return !py.has(this.constant, text_of_items(py.at(sides, 1)));
}
return this.is_turning(py.at(sides, 1));
return null;
}
is_turning(value) {
let _, call, is_data, name, part, text;
call = call_of(value);
text = text_of_items((((call) ?? null) === (null) ? value : py.at(call, 1).items));
if (py.truth(py.call(text, "startswith", "#"))) {
return py.has(_TURNING, text);
}
[name, , part] = [...py.iter(py.call(text, "partition", "."))];
is_data = py.either(((call) ?? null) !== (null), () => py.same(part, "ORI_TYP"));
return py.both(is_data, () => !py.has(this.constant, name));
return null;
}
}
class _SourceReader extends Reader {
constructor(draft = null, file = null, code = null, harmless = null, entries = null, language = null, data = null) {
super();
this.draft = draft;
this.file = file;
this.code = code;
this.harmless = harmless;
this.entries = entries;
this.language = language;
this.data = data;
}
declare(k) {
let action, condition, first, is_part, items, name, part, reason, sides, statement;
statement = py.at(this.statements, k);
items = statement.items;
while (py.truth(py.both(items, () => py.has(["GLOBAL", "DECL", "CONST"], word(py.at(items, 0)))))) {
items = py.text(items).slice(1, undefined);
}
first = (py.truth(items) ? word(py.at(items, 0)) : "");
if (py.truth(py.either(!py.truth(items), () => py.either(py.has(_MOTIONS, first), () => py.either(py.has(_RELATIVE, first), () => py.has(_ROUTINES, first)))))) {
return null;
}
if (py.same(first, "IMPORT")) {
reason = ("line " + py.str(statement.line) + " shares it with another file");
for (const $each of py.iter(py.sorted(this.words(py.text(items).slice(1, undefined))))) {
name = $each;
this.draft.write(name, reason);
}
return null;
}
action = _action(items);
if (py.truth(action)) {
condition = py.text(items).slice(undefined, -py.len(action));
this.pass_arguments(statement.line, condition);
this.draft.read(this.words(condition));
items = action;
} else {
if (py.has(["ANIN", "DIGIN"], first)) {
items = py.text(items).slice(2, undefined);
} else {
if (py.truth(py.both((py.len(items) > 1), () => py.both(first, () => word(py.at(items, 1)))))) {
items = py.text(items).slice(1, undefined);
}
}
}
this.pass_arguments(statement.line, items);
for (const $each of py.iter(split(items))) {
part = $each;
sides = split(part, "=");
[name, is_part] = [...py.iter(element_name(py.at(sides, 0)))];
if (py.truth(py.either(!py.same(py.len(sides), 2), () => !py.truth(name)))) {
this.draft.read(this.words(part));
} else {
if (!py.truth(this._note_data(name, py.at(sides, 1)))) {
this._set(statement.line, name, is_part, py.at(sides, 1));
}
}
}
return null;
}
_note_data(name, value) {
let fields, group, is_mode, is_new, mass, turning;
group = aggregate(value, "{");
fields = py.either((((group) ?? null) !== (null) ? _fields(group) : null), () => new py.Dict([]));
turning = py.call(fields, "get", "ORI_TYP", []);
if (py.truth(py.both(turning, () => !py.has(_TURNING, text_of_items(turning))))) {
py.call(this.data.constant, "add", name);
}
is_mode = py.both(py.same(name, "$IPO_MODE"), () => ((call_of(value)) ?? null) === (null));
if (py.truth(py.both(is_mode, () => !py.same(text_of_items(value), "#BASE")))) {
this.data.tool_is_fixed();
}
if (py.truth(py.both(py.has(fields, "TOOL_NO"), () => py.has(fields, "BASE_NO")))) {
is_new = !py.has(this.data.frames, name);
py.put(this.data.frames, name, (py.truth(is_new) ? _frame_data(fields) : null));
return true;
}
if (py.has(this.data.frames, name)) {
py.put(this.data.frames, name, null);
}
mass = this._mass(value);
if (py.truth(py.both(((mass) ?? null) !== (null), () => py.call(name, "startswith", "LOAD_DATA[")))) {
py.put(this.draft.masses, name, mass);
}
return false;
return null;
}
_set(line, name, is_part, value) {
let is_frame, is_pose, point, pose;
point = (py.truth(py.either(is_part, () => py.has(name, "*"))) ? null : this.literal(line, name, value));
is_frame = py.call(name, "startswith", ["TOOL_DATA[", "BASE_DATA[", "$"]);
if (py.truth(py.both(py.isinstance(point, [Point]), () => py.both(py.same(point.kind, "pose"), () => !py.truth(py.call(name, "startswith", "$")))))) {
is_pose = this.language.is_pose(point.values);
pose = (py.truth(is_pose) ? this.language.pose(point.values) : "its numbers are no pose");
this.draft.frame(name, pose, ["tool", "base"]);
}
if (py.truth(py.either(!py.truth(is_frame), () => ((point) ?? null) === (null)))) {
this.assign(line, name, is_part, value);
} else {
if (py.truth(py.isinstance(point, [Skipped]))) {
this.draft.write(name, point.reason);
}
}
return null;
}
literal(line, name, items) {
let external, fields, found, group, keys, numbers, posture;
group = aggregate(items, "{");
fields = (((group) ?? null) !== (null) ? _fields(group) : null);
keys = py.next((() => { const $out = []; for (const keys of py.iter([_POSE, _JOINTS])) { if (py.truth(py.both(((fields) ?? null) !== (null), () => py.and(py.set(keys), py.set(fields))))) $out.push(keys); } return $out; })(), null);
if (py.truth(py.either(((fields) ?? null) === (null), () => ((keys) ?? null) === (null)))) {
return null;
}
numbers = (() => { const $out = []; for (const key of py.iter(keys)) { $out.push(number_of(py.call(fields, "get", key, []))); } return $out; })();
found = py.tuple((() => { const $out = []; for (const number of py.iter(numbers)) { if (((number) ?? null) !== (null)) $out.push(number); } return $out; })());
if ((py.len(found) < py.len(keys))) {
return this.skip(name, line, ("not all of " + py.str(py.call(" ", "join", keys)) + " are given as numbers"));
}
external = (() => { const $out = []; for (const key of py.iter(_EXTERNAL)) { if (py.has(fields, key)) $out.push(number_of(py.at(fields, key))); } return $out; })();
if (py.truth(py.any((() => { const $out = []; for (const number of py.iter(external)) { $out.push(py.either(((number) ?? null) === (null), () => !py.same(number.value, 0.0))); } return $out; })()))) {
return this.skip(name, line, EXTERNAL);
}
if (py.same(keys, _JOINTS)) {
return new Point(name, this.file, line, "joints", found);
}
posture = _posture(fields);
if (((posture) ?? null) === (null)) {
return this.skip(name, line, "S or T is not a number");
}
return new Point(name, this.file, line, "pose", found, posture);
return null;
}
move(k) {
let displaced, first, items, moved, path, places, tool;
items = py.at(this.statements, k).items;
first = word(py.at(items, 0));
if (py.has(_RELATIVE, first)) {
this._move_relatively(k);
return null;
}
if (py.truth(py.either(!py.has(_MOTIONS, first), () => py.either((py.len(items) < 2), () => is_token(py.at(items, 1), "SIGN", "="))))) {
return null;
}
places = _places(py.text(items).slice(1, undefined));
if (!py.truth(places.parts)) {
return null;
}
path = places.path(py.at(_MOTIONS, first));
tool = this._frame("$TOOL", k);
displaced = this.displaced(k, [POSITIONS]);
moved = py.either(displaced, () => this._why_moved(k, !py.same(py.at(_MOTIONS, first), "joint")));
py.call(this.draft.motions, "append", new Motion(path, py.tuple((() => { const $out = []; for (const part of py.iter(places.parts)) { $out.push(this.target(k, part)); } return $out; })()), py.at(this.statements, k), this.file, tool, (py.truth(moved) ? new Frame("$BASE", undefined, moved) : this._frame("$BASE", k)), place_of(py.at(places.parts, -1)), py.at(this.flow, k).run, py.both(py.same(path, "line"), () => !py.truth(this._splines(k))), py.has(_BY_POSTURE, first), py.either(this.load(k), () => this._load_of_tool(k, tool)), displaced));
return null;
}
_move_relatively(k) {
let lost, name, run, statement;
statement = py.at(this.statements, k);
this.draft.read(this.words(py.text(statement.items).slice(1, undefined)));
name = py.text(text_of_items(statement.items)).slice(undefined, 40);
lost = this.skip(name, statement.line, "a relative motion");
run = py.at(this.flow, k).run;
py.call(this.draft.motions, "append", new Motion("joint", [lost], statement, this.file, undefined, undefined, undefined, run));
return null;
}
_splines(k) {
return (() => { const $out = []; for (const j of py.iter(py.at(this.flow, k).blocks)) { if (py.truth(py.call(py.at(this.steps, j).opens, "endswith", "SPLINE"))) $out.push(j); } return $out; })();
return null;
}
_settings(k) {
let found, items, j, start;
found = [];
for (const $each of py.iter([k, ...py.iter(this._splines(k))])) {
j = $each;
items = py.at(this.statements, j).items;
start = py.next((() => { const $out = []; for (const [i, item] of py.iter(py.enumerate(items))) { if (py.same(word(item), "WITH")) $out.push(py.add(i, 1)); } return $out; })(), py.len(items));
found = py.add(found, split(py.text(items).slice(start, undefined)));
}
return found;
return null;
}
_load_of_tool(k, tool) {
let line, name;
name = py.call(tool.name, "replace", "TOOL_", "LOAD_");
line = py.at(this.statements, k).line;
return (py.has(this.draft.masses, name) ? new Load(name, line, py.at(this.draft.masses, name)) : null);
return null;
}
mass(statement) {
let mass, sides;
sides = split(statement.items, "=");
if (py.same(py.len(sides), 2)) {
mass = this._mass(py.at(sides, 1));
return (((mass) ?? null) !== (null) ? mass : py.call(this.draft.masses, "get", text_of_items(py.at(sides, 1))));
}
return null;
return null;
}
_mass(items) {
let fields, group, number;
group = aggregate(items, "{");
fields = (((group) ?? null) !== (null) ? _fields(group) : null);
number = (py.truth(py.both(((fields) ?? null) !== (null), () => py.has(fields, "M"))) ? number_of(py.at(fields, "M")) : null);
return (py.truth(py.both(((number) ?? null) !== (null), () => (number.value >= 0.0))) ? number.value : null);
return null;
}
_why_moved(k, is_line) {
let is_part, is_turning, kinds, line, name, part, sides;
line = py.at(this.statements, k).line;
is_turning = false;
for (const $each of py.iter(this._settings(k))) {
part = $each;
sides = split(part, "=");
[name, is_part] = [...py.iter(element_name(py.at(sides, 0)))];
name = py.at(py.call(name, "partition", "["), 0);
if (py.truth(py.both(py.same(py.len(sides), 2), () => py.either(!py.has(_VARIABLES, name), () => py.both(is_part, () => py.has(_FRAMES, name)))))) {
return ("line " + py.str(line) + " sets " + py.str(name));
}
if (py.truth(py.both(py.same(py.len(sides), 2), () => py.same(name, _ORIENTATION)))) {
is_turning = this.data.is_turning(py.at(sides, 1));
if (!py.truth(is_turning)) {
return ("line " + py.str(line) + " does not turn the tool ($ORI_TYPE)");
}
}
}
kinds = (py.truth(py.both(is_line, () => !py.truth(is_turning))) ? [_ROBOT, _ORIENTATION] : [_ROBOT]);
return this.displaced(k, kinds);
return null;
}
_frame(variable, k) {
let found, hint, part, sides, why;
if (py.truth(this.data.is_fixed)) {
return new Frame(variable, undefined, "the tool is fixed in the cell ($IPO_MODE=#TCP)");
}
for (const $each of py.iter(this._settings(k))) {
part = $each;
sides = split(part, "=");
if (py.truth(py.both(py.same(py.len(sides), 2), () => py.same(text_of_items(py.at(sides, 0)), variable)))) {
return this._frame_of(variable, k, py.at(sides, 1));
}
}
found = py.call(py.at(this.flow, k).setters, "get", variable);
if (py.truth(py.both(((found) ?? null) === (null), () => this.starts_displaced(k, variable)))) {
found = "a routine that calls this one sets it";
}
if (py.truth(py.isinstance(found, ["int"]))) {
return this._frame_set_by(variable, found, k);
}
hint = (" (--with its file, or --" + py.str(py.call(py.text(variable).slice(1, undefined), "lower")) + " '" + py.str(variable) + "=X,Y,Z,...')");
why = (py.str(variable) + ": " + py.str(found) + py.str((py.truth(py.both(((found) ?? null) !== (null), () => py.has(found, OUTSIDE))) ? hint : "")));
return new Frame(variable, undefined, (((found) ?? null) !== (null) ? why : ""));
return null;
}
_frame_set_by(variable, found, k) {
let call, fields, group, index, setter, sides, source, value, what, why;
setter = py.at(this.statements, found).items;
sides = split(setter, "=");
if (py.same(py.len(sides), 2)) {
return this._frame_of(variable, k, py.at(sides, 1));
}
call = call_of(setter);
index = (py.truth(py.both(((call) ?? null) !== (null), () => (py.len(py.at(call, 1).parts) > 1))) ? number_of(py.at(py.at(call, 1).parts, 1)) : null);
what = _by_bas(setter);
if (py.truth(py.both(py.has(["#TOOL", "#BASE"], what), () => ((index) ?? null) !== (null)))) {
return _frame_named((py.str(py.text(what).slice(1, undefined)) + "_DATA[" + py.str(index.text) + "]"));
}
if (!py.has(_BY_DATA, what)) {
return new Frame(variable, undefined, ("line " + py.str(py.at(this.statements, found).line) + " may set " + py.str(variable)));
}
source = py.call(py.at(this.flow, found).setters, "get", "FDAT_ACT");
if (!py.truth(py.isinstance(source, ["int"]))) {
why = ("FDAT_ACT: " + py.str((((source) ?? null) !== (null) ? source : "it is set elsewhere")));
return new Frame(variable, undefined, why);
}
value = py.at(split(py.at(this.statements, source).items, "="), 1);
group = aggregate(value, "{");
fields = (((group) ?? null) !== (null) ? _fields(group) : null);
if (py.truth(py.both(((fields) ?? null) !== (null), () => py.both(py.has(fields, "TOOL_NO"), () => py.has(fields, "BASE_NO"))))) {
return _frame_of_pair(variable, _frame_data(fields));
}
return _frame_of_data(variable, text_of_items(value), this.data);
return null;
}
_frame_of(variable, k, items) {
let call, found, frame, name;
found = this.literal(0, variable, items);
if (py.truth(py.both(py.isinstance(found, [Point]), () => !py.truth(this.language.is_pose(found.values))))) {
return new Frame(variable, undefined, (py.str(variable) + ": its numbers are no pose"));
}
if (py.truth(py.both(py.isinstance(found, [Point]), () => py.same(found.kind, "pose")))) {
return new Frame(variable, this.language.pose(found.values));
}
call = call_of(items);
if (py.truth(py.both(((call) ?? null) !== (null), () => py.has(["STOOL", "STOOL2", "SBASE"], py.call(py.at(call, 0), "upper"))))) {
name = py.at(py.call(text_of_items(py.at(call, 1).items), "partition", "."), 0);
return _frame_of_data(variable, name, this.data);
}
frame = this.frame(k, items, (py.str(variable) + " is computed"));
return (py.truth(frame.reason) ? frame : _frame_named(frame.name));
return null;
}
}
class _Places {
constructor(parts = null, is_arc = null) {
this.parts = parts;
this.is_arc = is_arc;
}
path(usual) {
let is_usual;
is_usual = py.both(!py.truth(this.is_arc), () => py.same(py.len(this.parts), py.add(1, py.same(usual, "circle"))));
return (py.truth(is_usual) ? usual : "joint");
return null;
}
}
function _places(items) {
let parts, places, stop;
stop = py.next((() => { const $out = []; for (const [j, item] of py.iter(py.enumerate(items))) { if (py.has(_AFTER, word(item))) $out.push(j); } return $out; })(), py.len(items));
parts = (() => { const $out = []; for (const part of py.iter(split(py.text(items).slice(undefined, stop)))) { if (py.truth(part)) $out.push(part); } return $out; })();
places = (() => { const $out = []; for (const part of py.iter(parts)) { if (!py.same(word(py.at(part, 0)), "CA")) $out.push(part); } return $out; })();
return new _Places(places, (py.len(places) < py.len(parts)));
return null;
}
function _check_outside(code) {
let outside;
outside = (() => { const $out = []; for (const [statement, step, known] of py.iter(py.zip(code.statements, code.steps, code.flow))) { if (py.truth(py.both(!py.truth(known.depth), () => !py.truth(step.opens)))) $out.push(statement); } return $out; })();
if (py.truth(py.either(outside, () => !py.truth(code.statements)))) {
throw code.source.error(py.add("a statement outside DEF or DEFDAT; expected ", _WORDS), (py.truth(outside) ? py.at(outside, 0).start : 0));
}
return null;
}
function _takes_values(statement, step) {
let parts;
parts = (() => { const $out = []; for (const item of py.iter(statement.items)) { if (py.truth(py.isinstance(item, [Brackets]))) for (const part of py.iter(item.parts)) { if (py.truth(part)) $out.push(part); } } return $out; })();
return py.both(py.bool(step.routine), () => py.all((() => { const $out = []; for (const part of py.iter(parts)) { $out.push(py.same(word(py.at(part, -1)), "IN")); } return $out; })()));
return null;
}
function _frame_named(name) {
return new Frame(name, (py.has(_NULL, name) ? np.eye(4) : null));
return null;
}
function _frame_of_data(variable, name, data) {
let found;
found = py.call(data.frames, "get", name);
if (((found) ?? null) === (null)) {
return new Frame(variable, undefined, ("the frame data " + py.str(name) + " are not in these files, or not as numbers"));
}
return _frame_of_pair(variable, found);
return null;
}
function _frame_of_pair(variable, pair) {
if (((pair) ?? null) === (null)) {
return new Frame(variable, undefined, "the numbers of its tool and its base are not in numbers");
}
return _frame_named((py.same(variable, "$TOOL") ? py.at(pair, 0) : py.at(pair, 1)));
return null;
}
function _frame_data(fields) {
let base, tool;
tool = number_of(py.at(fields, "TOOL_NO"));
base = number_of(py.at(fields, "BASE_NO"));
if (py.truth(py.either(((tool) ?? null) === (null), () => py.either(((base) ?? null) === (null), () => !py.has(["", "#BASE"], text_of_items(py.call(fields, "get", "IPO_FRAME", []))))))) {
return null;
}
return [("TOOL_DATA[" + py.str(tool.text) + "]"), ("BASE_DATA[" + py.str(base.text) + "]")];
return null;
}
function _fields(group) {
let found, k, part;
found = py.dict();
for (const $each of py.iter(py.enumerate(group.parts))) {
[k, part] = $each;
if (py.truth(py.both(py.same(k, 0), () => py.both((py.len(part) > 2), () => py.both(word(py.at(part, 0)), () => is_token(py.at(part, 1), "SIGN", ":")))))) {
part = py.text(part).slice(2, undefined);
}
if (py.truth(py.either((py.len(part) < 2), () => py.either(!py.truth(word(py.at(part, 0))), () => py.has(found, word(py.at(part, 0))))))) {
return null;
}
py.put(found, word(py.at(part, 0)), py.text(part).slice(1, undefined));
}
return found;
return null;
}
function _bits(items) {
let digits, number, text;
if (py.truth(py.both(py.same(py.len(items), 1), () => is_token(py.at(items, 0), "BITS")))) {
text = py.str(py.at(items, 0));
digits = py.text(text).slice(2, -1);
if (py.truth(py.both(py.has("Bb", py.at(text, 1)), () => py.call(digits, "strip", "01")))) {
return null;
}
return new Number(py.int(digits, (py.has("Bb", py.at(text, 1)) ? 2 : 16)), ...py.iter(place_of(items)), text);
}
number = number_of(items);
return (py.truth(py.both(((number) ?? null) !== (null), () => py.call(number.text, "isdigit"))) ? number : null);
return null;
}
function _posture(fields) {
let bits, number, status, turns;
[status, number] = [...py.iter((() => { const $out = []; for (const name of py.iter(["S", "T"])) { $out.push((py.has(fields, name) ? _bits(py.at(fields, name)) : null)); } return $out; })())];
if (py.truth(py.either(py.both(((status) ?? null) === (null), () => py.has(fields, "S")), () => py.both(((number) ?? null) === (null), () => py.has(fields, "T"))))) {
return null;
}
turns = [];
if (((number) ?? null) !== (null)) {
turns = py.tuple((() => { const $out = []; for (const j of py.iter(py.range(6))) { $out.push(new Turn(j, "negative", py.and((py.int(number.value) >> j), 1), number, j)); } return $out; })());
}
if (((status) ?? null) === (null)) {
return new Posture(undefined, undefined, undefined, turns);
}
bits = py.int(status.value);
return new Posture(!py.truth(py.and(bits, 1)), py.bool(py.and(bits, 2)), !py.truth(py.and(bits, 4)), turns);
return null;
}
function _by_bas(items) {
let call;
call = call_of(items);
return (py.truth(py.both(((call) ?? null) !== (null), () => py.both(py.same(py.call(py.at(call, 0), "upper"), "BAS"), () => py.at(call, 1).parts))) ? text_of_items(py.at(py.at(call, 1).parts, 0)) : "");
return null;
}
function _step(statement) {
let calls, first, items, names, opens;
items = statement.items;
first = word(py.at(items, 0));
opens = (py.truth(py.both(py.same(first, "GLOBAL"), () => (py.len(items) > 1))) ? word(py.at(items, 1)) : first);
if (py.has(_ROUTINES, opens)) {
return new Step(opens, undefined, py.at((() => { const $out = []; for (const item of py.iter(items)) { if (py.truth(word(item))) $out.push(word(item)); } return $out; })(), -1));
}
names = (() => { const $out = []; for (const [name, ] of py.iter(calls_in(items))) { $out.push(py.call(name, "upper")); } return $out; })();
calls = py.tuple((() => { const $out = []; for (const name of py.iter(names)) { if (py.truth(py.both(!py.has(_HARMLESS, name), () => !py.has(_FILLERS, name)))) $out.push(name); } return $out; })());
if (py.truth(py.any((() => { const $out = []; for (const item of py.iter(items)) { $out.push(py.same(word(item), "DO")); } return $out; })()))) {
return _started(_action(items), calls);
}
if (py.truth(py.either(py.has(_LOOPS, first), () => py.has(_BLOCKS, first)))) {
return new Step(first, undefined, undefined, py.has(_LOOPS, first), undefined, undefined, undefined, undefined, calls);
}
if (py.has(_CLOSES, first)) {
return new Step(undefined, py.at(_CLOSES, first), undefined, undefined, undefined, undefined, undefined, undefined, calls);
}
if (py.truth(py.either(py.has(["ELSE", "CASE", "DEFAULT"], first), () => py.both(py.same(py.len(items), 2), () => is_token(py.at(items, 1), "SIGN", ":"))))) {
return new Step(undefined, undefined, undefined, undefined, true);
}
if (py.same(first, "BAS")) {
return new Step(undefined, undefined, undefined, undefined, undefined, undefined, _set_by_bas(items));
}
return (py.has(_MOTIONS, first) ? new Step(undefined, undefined, undefined, undefined, undefined, undefined, undefined, undefined, calls) : _assigned(items, calls));
return null;
}
function _action(items) {
let done;
done = (() => { const $out = []; for (const [k, item] of py.iter(py.enumerate(items))) { if (py.same(word(item), "DO")) $out.push(k); } return $out; })();
return (py.truth(done) ? py.text(items).slice(py.add(py.at(done, -1), 1), undefined) : []);
return null;
}
function _started(action, calls) {
let changed, name;
name = py.at(element_name(py.at(split(action, "="), 0)), 0);
changed = (py.truth(action) ? _set_by_assignment(action, name) : py.frozenset());
return new Step(undefined, undefined, undefined, undefined, undefined, undefined, undefined, py.or(changed, py.and(new Set([name]), _FRAMES)), undefined, calls);
return null;
}
function _assigned(items, calls) {
let is_part, name, sides, what;
sides = split(items, "=");
[name, is_part] = [...py.iter(element_name(py.at(sides, 0)))];
if (py.truth(py.either(!py.same(py.len(sides), 2), () => !py.has(_SETTABLE, name)))) {
return new Step(undefined, undefined, undefined, undefined, undefined, undefined, undefined, _set_by_assignment(items, name), calls);
}
what = py.frozenset(new Set([py.call(new py.Dict([["LDAT_ACT", _ORIENTATION], ["$LOAD", STATED_LOAD]]), "get", name, name)]));
return (py.truth(is_part) ? new Step(undefined, undefined, undefined, undefined, undefined, undefined, undefined, what, calls) : new Step(undefined, undefined, undefined, undefined, undefined, undefined, what, undefined, calls));
return null;
}
function _set_by_bas(items) {
let one, what;
what = _by_bas(items);
if (py.same(what, "#INITMOV")) {
return py.or(_FRAMES, new Set([_ORIENTATION]));
}
one = new py.Dict([["#TOOL", py.frozenset(new Set(["$TOOL"]))], ["#BASE", py.frozenset(new Set(["$BASE"]))]]);
return py.call(one, "get", what, (py.has(_SPEEDS, what) ? py.frozenset() : _FRAMES));
return null;
}
function _set_by_assignment(items, name) {
let first, is_assignment, is_call, is_known, stem;
first = word(py.at(items, 0));
stem = py.at(py.call(name, "partition", "["), 0);
is_assignment = py.any((() => { const $out = []; for (const item of py.iter(items)) { $out.push(is_token(item, "SIGN", "=")); } return $out; })());
if (py.truth(is_assignment)) {
if (py.truth(py.either(!py.truth(py.call(stem, "startswith", "$")), () => py.has(_VARIABLES, stem)))) {
return py.frozenset();
}
return py.frozenset(new Set([(py.has(_PLACES, stem) ? _ROBOT : POSITIONS)]));
}
is_call = py.both((py.len(items) > 1), () => py.both(py.isinstance(py.at(items, 1), [Brackets]), () => py.same(py.at(items, 1).kind, "(")));
is_known = py.either(py.has(_INSTRUCTIONS, first), () => py.either(py.has(_RELATIVE, first), () => is_call));
return (py.truth(py.either(is_known, () => !py.truth(first))) ? py.frozenset() : py.frozenset(new Set([POSITIONS])));
return null;
}
return { _TOKENS, _WORDS, _ROUTINES, _LOOPS, _BLOCKS, _CLOSES, _MOTIONS, _BY_POSTURE, _RELATIVE, _AFTER, _POSE, _JOINTS, _EXTERNAL, _NULL, _FRAMES, _BY_DATA, _SPEEDS, _MANUAL, _KRL_WORDS, _INSTRUCTIONS, _HARMLESS, _FILLERS, _VARIABLES, _TURNING, _ORIENTATION, _ROBOT, _PLACES, _SETTABLE, Krl, _Data, _SourceReader, _Places, _places, _check_outside, _takes_values, _frame_named, _frame_of_data, _frame_of_pair, _frame_data, _fields, _bits, _posture, _by_bas, _step, _action, _started, _assigned, _set_by_bas, _set_by_assignment };
})();
MODULES.rapid = (() => {
const { Draft } = MODULES.draft;
const { Code, Step, followed } = MODULES.flow;
const { ControllerLanguage } = MODULES.language;
const { Frame, Load, Motion, Point, Posture, Program, Skipped, Turn } = MODULES.program;
const { BY_NAME, DISPLACES, GRAMMAR, JOINTS_TOO, MOTION_OPTIONS, MOTIONS, OF_OPTIONS, ONCE, RAPID_FUNCTIONS, RAPID_WORDS, READING, SWITCHES, are_at_rest, check_blocks, code_of, ends_displacement, is_assignment } = MODULES.rapid_blocks;
const { EXTERNAL, Entries, Reader, formal_names } = MODULES.statement_reader;
const { Brackets, Number, Statement, aggregate, calls_in, element_name, number_of, numbers_of, place_of, split, text_of_items, word, words_in } = MODULES.syntax;
let _SEARCHES;
_SEARCHES = ["SEARCHL", "SEARCHJ", "SEARCHC"];
let _STORAGE;
_STORAGE = ["CONST", "PERS", "VAR"];
let _TARGETS;
_TARGETS = ["ROBTARGET", "JOINTTARGET"];
let _DATA;
_DATA = [...py.iter(_TARGETS), "TOOLDATA", "WOBJDATA"];
let _CHANGEABLE;
_CHANGEABLE = ["INOUT", "PERS", "VAR", "REF"];
class Rapid extends ControllerLanguage {
read(sources) {
let code, draft, ends, entries, files, harmless, has_handlers, i, k, reader, switched;
draft = new Draft(sources);
draft.frame("TOOL0", np.eye(4), ["tool"]);
draft.frame("WOBJ0", np.eye(4), ["base"]);
py.call(draft.constants, "update", ["TOOL0", "WOBJ0"]);
files = (() => { const $out = []; for (const source of py.iter(sources)) { $out.push(code_of(source)); } return $out; })();
switched = py.frozenset((() => { const $out = []; for (const code of py.iter(files)) { for (const step of py.iter(code.steps)) { for (const name of py.iter(step.sets)) { $out.push(name); } } } return $out; })());
has_handlers = py.any((() => { const $out = []; for (const code of py.iter(files)) { for (const statement of py.iter(code.statements)) { $out.push(py.same(word(py.at(statement.items, 0)), "ERROR")); } } return $out; })());
ends = (py.truth(has_handlers) ? null : ends_displacement);
files = followed(files, py.and(switched, py.set(DISPLACES)), ends);
for (const $each of py.iter(files)) {
code = $each;
check_blocks(code);
}
harmless = py.or(py.or(RAPID_FUNCTIONS, py.set(READING)), _that_keep_parameters(files));
entries = new Entries(files, ends_displacement, DISPLACES);
for (const $each of py.iter(py.enumerate(files))) {
[i, code] = $each;
reader = new _ModuleReader(draft, i, code, harmless, entries, this, switched);
for (const $each of py.iter(py.range(py.len(code.statements)))) {
k = $each;
reader.statement(k);
}
}
return draft.finish();
return null;
}
statement(motion, source, values, posture) {
let conf, end, position, shape, start, target, text, turn;
[start, end] = [...py.iter(motion.span)];
position = py.call(",", "join", (() => { const $out = []; for (const value of py.iter(py.text(values).slice(undefined, 3))) { $out.push((py.format(value, (".4f")))); } return $out; })());
turn = py.call(",", "join", (() => { const $out = []; for (const value of py.iter(py.text(values).slice(3, undefined))) { $out.push((py.format(value, (".9f")))); } return $out; })());
shape = py.add(py.add((4 * !py.truth(posture.front)), (2 * !py.truth(posture.up))), !py.truth(posture.down));
conf = py.call(",", "join", [...py.iter((() => { const $out = []; for (const turn of py.iter(posture.turns)) { $out.push(py.str(turn.value)); } return $out; })()), py.str(shape)]);
target = ("[[" + py.str(position) + "],[" + py.str(turn) + "],[" + py.str(conf) + "],[9E9,9E9,9E9,9E9,9E9,9E9]]");
text = py.add(py.add(py.text(source.text).slice(motion.statement.start, start), target), py.text(source.text).slice(end, motion.statement.end));
return py.add(_in_zone(text), ";");
return null;
}
tool(group) {
let parts, pose;
parts = (((group) ?? null) !== (null) ? group.parts : []);
if (py.truth(py.either(!py.same(py.len(parts), 3), () => !py.same(text_of_items(py.at(parts, 0)), "TRUE")))) {
return "the robot does not hold it, or its values are computed";
}
pose = this._frame(py.at(parts, 1));
return (((pose) ?? null) !== (null) ? pose : "its values are computed");
return null;
}
work_object(group) {
let own, parts, user;
parts = (((group) ?? null) !== (null) ? group.parts : []);
if (py.truth(py.either(!py.same(py.len(parts), 5), () => py.either(!py.same(text_of_items(py.at(parts, 0)), "FALSE"), () => !py.same(text_of_items(py.at(parts, 1)), "TRUE"))))) {
return "the robot holds it, it moves, or its values are computed";
}
user = this._frame(py.at(parts, 3));
own = this._frame(py.at(parts, 4));
return (py.truth(py.both(((user) ?? null) !== (null), () => ((own) ?? null) !== (null))) ? py.matmul(user, own) : "its values are computed");
return null;
}
_frame(part) {
let group, lists, values;
group = aggregate(part, "[");
lists = (((group) ?? null) !== (null) ? _lists(group) : null);
if (py.truth(py.either(((lists) ?? null) === (null), () => !py.same((() => { const $out = []; for (const each of py.iter(lists)) { $out.push(py.len(each)); } return $out; })(), [3, 4])))) {
return null;
}
values = np.array((() => { const $out = []; for (const each of py.iter(lists)) { for (const number of py.iter(each)) { $out.push(number.value); } } return $out; })());
return (py.truth(this.is_pose(values)) ? this.pose(values) : null);
return null;
}
}
Rapid.prototype.name = "RAPID";
Rapid.prototype.suffixes = [".mod", ".prg", ".sys", ".modx", ".sysx"];
Rapid.prototype.reads_others = true;
Rapid.prototype.convention = "abb";
Rapid.prototype.digits = [4, 9, 7];
Rapid.prototype.can_insert = true;
Rapid.prototype.grammars = [GRAMMAR];
Rapid.prototype.understood = RAPID_WORDS;
LANGUAGES.register(Rapid);
class _ModuleReader extends Reader {
constructor(draft = null, file = null, code = null, harmless = null, entries = null, language = null, switched = null) {
super();
this.draft = draft;
this.file = file;
this.code = code;
this.harmless = harmless;
this.entries = entries;
this.language = language;
this.switched = switched;
}
literal(line, name, items) {
let group, lists, posture, sizes;
group = aggregate(items, "[");
if (((group) ?? null) === (null)) {
return null;
}
lists = _lists(group);
sizes = (((lists) ?? null) !== (null) ? (() => { const $out = []; for (const each of py.iter(lists)) { $out.push(py.len(each)); } return $out; })() : []);
if (py.truth(py.either(((lists) ?? null) === (null), () => !py.has([[3, 4, 4, 6], [6, 6]], sizes)))) {
return this.skip(name, line, "not all of its values are numbers");
}
if (py.truth(py.both(py.same(sizes, [6, 6]), () => !py.truth(are_at_rest(py.at(lists, 1)))))) {
return this.skip(name, line, EXTERNAL);
}
if (py.same(sizes, [6, 6])) {
return new Point(name, this.file, line, "joints", py.at(lists, 0));
}
if (!py.truth(are_at_rest(py.at(lists, 3)))) {
return this.skip(name, line, EXTERNAL);
}
posture = _posture(py.at(lists, 2));
if (((posture) ?? null) === (null)) {
return this.skip(name, line, "its configuration is invalid");
}
return new Point(name, this.file, line, "pose", [...py.iter(py.at(lists, 0)), ...py.iter(py.at(lists, 1))], posture);
return null;
}
statement(k) {
let first, is_constant, items, line, sides, statement, step, storage;
statement = py.at(this.statements, k);
step = py.at(this.steps, k);
items = statement.items;
line = statement.line;
first = word(py.at(items, 0));
if (py.truth(py.either(step.opens, () => py.either(step.closes, () => step.is_jump)))) {
if (!py.truth(step.routine)) {
this.pass_arguments(line, items);
this.draft.read(this.words(items));
}
return null;
}
if (py.has(MOTIONS, first)) {
this._move(k);
return null;
}
this.pass_arguments(line, items);
storage = (() => { const $out = []; for (const [j, item] of py.iter(py.enumerate(py.text(items).slice(undefined, 2)))) { if (py.has(_STORAGE, word(item))) $out.push(j); } return $out; })();
sides = split(items, ":=");
if (py.truth(storage)) {
is_constant = py.same(word(py.at(items, py.at(storage, 0))), "CONST");
this._declare(line, py.text(items).slice(py.add(py.at(storage, 0), 1), undefined), is_constant);
} else {
if (py.truth(py.both(py.same(py.len(sides), 2), () => is_assignment(items)))) {
this.assign(line, ...py.iter(element_name(py.at(sides, 0))), py.at(sides, 1));
} else {
if (py.has(_SEARCHES, first)) {
this._search(statement);
} else {
this._instruct(statement);
}
}
}
return null;
}
_search(statement) {
let first, line, plain, reason, stops;
line = statement.line;
reason = "it ends when a signal arrives";
py.call(this.draft.skipped, "append", this.skip(("search of line " + py.str(line)), line, reason));
plain = (() => { const $out = []; for (const part of py.iter(split(py.text(statement.items).slice(1, undefined)))) { $out.push(py.at(split(part, "\\"), 0)); } return $out; })();
stops = py.text((() => { const $out = []; for (const part of py.iter(plain)) { if (py.truth(part)) $out.push(part); } return $out; })()).slice(1, 2);
first = word(py.at(statement.items, 0));
this.draft.pass_to(first, (() => { const $out = []; for (const part of py.iter(stops)) { $out.push(py.at(element_name(part), 0)); } return $out; })(), line);
this.draft.read(this.words(statement.items));
py.call(this.draft.motions, "append", new Motion("joint", [], statement, this.file, undefined, undefined, undefined, -1));
return null;
}
_instruct(statement) {
let first, line;
line = statement.line;
first = word(py.at(statement.items, 0));
if (py.has(BY_NAME, first)) {
this.draft.write_any(("line " + py.str(line) + " sets data by their names (" + py.str(first) + ")"));
}
if (py.truth(py.both(py.has(SWITCHES, first), () => !py.same(first, "MOVEEXTJ")))) {
this.draft.derive("displacement", this.words(py.text(statement.items).slice(1, undefined)));
} else {
if (py.truth(py.both(!py.has(this.harmless, first), () => !py.has(SWITCHES, first)))) {
this.draft.pass_to(py.either(first, () => "a routine"), this.words(py.text(statement.items).slice(1, undefined)), line);
}
}
this.draft.read(this.words(statement.items));
return null;
}
_declare(line, items, is_constant) {
let bracket, group, index, kind, mass, name, part, sides, size, stem, value;
kind = (py.truth(items) ? word(py.at(items, 0)) : "");
sides = split(py.text(items).slice(1, undefined), ":=");
name = py.at(element_name(py.at(sides, 0)), 0);
value = (py.same(py.len(sides), 2) ? py.at(sides, 1) : []);
group = aggregate(value, "[");
if (py.truth(py.both(py.same(kind, "LOADDATA"), () => py.both(((group) ?? null) !== (null), () => py.same(py.len(group.parts), 6))))) {
mass = number_of(py.at(group.parts, 0));
if (((mass) ?? null) !== (null)) {
py.put(this.draft.masses, name, mass.value);
}
}
if (py.truth(py.either(!py.has(_DATA, kind), () => !py.truth(name)))) {
this.draft.read(this.words(items));
return null;
}
if (py.truth(is_constant)) {
py.call(this.draft.constants, "add", name);
}
if (py.same(kind, "TOOLDATA")) {
this.draft.frame(name, this.language.tool(group), ["tool"]);
return null;
}
if (py.same(kind, "WOBJDATA")) {
this.draft.frame(name, this.language.work_object(group), ["base"]);
return null;
}
[stem, bracket, size] = [...py.iter(py.call(name, "partition", "["))];
if (!py.truth(bracket)) {
this._value(line, name, kind, value);
} else {
if (py.truth(py.both(((group) ?? null) !== (null), () => py.same(size, (py.str(py.len(group.parts)) + "]"))))) {
for (const $each of py.iter(py.enumerate(group.parts))) {
[index, part] = $each;
this._value(line, (py.str(stem) + "[" + py.str(py.add(index, 1)) + "]"), kind, part);
}
} else {
this.draft.write(stem, "an array of targets whose values are incomplete");
}
}
return null;
}
_value(line, name, kind, value) {
let target;
target = this.literal(line, name, value);
if (py.truth(py.both(py.isinstance(target, [Point]), () => !py.same(py.same(target.kind, "joints"), py.same(kind, "JOINTTARGET"))))) {
target = this.skip(name, line, "it is another kind of target");
}
if (((target) ?? null) !== (null)) {
this.draft.take(target);
} else {
this.draft.write(name, (py.truth(value) ? "a computed value" : "it is set while the program runs"));
}
return null;
}
_move(k) {
let count, displaced, first, given, path, places, statement, targets, tool, tools;
statement = py.at(this.statements, k);
first = word(py.at(statement.items, 0));
path = py.at(MOTIONS, first);
given = _arguments(py.text(statement.items).slice(1, undefined));
count = (py.same(path, "circle") ? 2 : 1);
places = py.text(given.plain).slice(undefined, count);
if ((py.len(places) < count)) {
this.not_understood(first, statement.line);
return null;
}
displaced = this._displaced(k, given.options);
targets = py.tuple((() => { const $out = []; for (const part of py.iter(places)) { $out.push(this.target(k, part)); } return $out; })());
tools = (py.has(OF_OPTIONS, first) ? py.text(given.plain).slice(-1, undefined) : py.text(given.plain).slice(py.add(count, 2), py.add(count, 3)));
tool = this.frame(k, (py.truth(tools) ? py.at(tools, 0) : []), "its tool is computed");
py.call(this.draft.motions, "append", new Motion(path, this._understood(targets, given.options, statement.line), statement, this.file, tool, this._base(k, given.options, displaced), place_of(py.at(places, -1)), py.at(this.flow, k).run, py.both(py.same(first, "MOVEL"), () => !py.same(py.at(this.steps, py.sub(k, 1)).opens, ONCE)), this._takes_posture(k, (py.same(path, "joint") ? "CONFJ" : "CONFL")), this._load_of(given.options, k), (py.same(first, "MOVEABSJ") ? displaced : "")));
return null;
}
_base(k, options, displaced) {
if (py.truth(displaced)) {
return new Frame("displacement", undefined, displaced);
}
if (!py.has(options, "WOBJ")) {
return new Frame("WOBJ0");
}
return this.frame(k, py.at(options, "WOBJ"), "its work object is computed");
return null;
}
_understood(targets, options, line) {
let unknown, why;
unknown = py.next((() => { const $out = []; for (const name of py.iter(options)) { if (!py.has(MOTION_OPTIONS, name)) $out.push(name); } return $out; })(), "");
if (!py.truth(unknown)) {
return targets;
}
why = ("line " + py.str(line) + ": \\" + py.str(unknown) + " is not understood and may displace it");
return py.tuple((() => { const $out = []; for (const target of py.iter(targets)) { $out.push(this.left(target, why)); } return $out; })());
return null;
}
_displaced(k, options) {
let is_joint, kinds;
if (py.has(options, "CORR")) {
return "the motion is corrected by a sensor (Corr)";
}
is_joint = py.same(word(py.at(py.at(this.statements, k).items, 0)), "MOVEABSJ");
kinds = (py.truth(is_joint) ? JOINTS_TOO : DISPLACES);
return this.displaced(k, (() => { const $out = []; for (const name of py.iter(kinds)) { if (py.has(this.switched, name)) $out.push(name); } return $out; })());
return null;
}
_load_of(options, k) {
let name;
if (!py.has(options, "TLOAD")) {
return this.load(k);
}
name = text_of_items(py.at(options, "TLOAD"));
return new Load(name, py.at(this.statements, k).line, py.call(this.draft.masses, "get", name));
return null;
}
mass(statement) {
let name;
name = text_of_items(py.text(statement.items).slice(1, undefined));
return (py.same(name, "LOAD0") ? 0.0 : py.call(this.draft.masses, "get", name));
return null;
}
_takes_posture(k, switch_) {
let found;
found = py.call(py.at(this.flow, k).setters, "get", switch_);
if (py.truth(py.isinstance(found, ["int"]))) {
return !py.has(this.words(py.at(this.statements, found).items), "OFF");
}
return py.both(((found) ?? null) === (null), () => !py.has(this.switched, switch_));
return null;
}
}
class _MoveArguments {
constructor(plain = null, options = null) {
this.plain = plain;
this.options = options;
}
}
function _arguments(items) {
let options, part, piece, pieces, plain, sides;
plain = [];
options = py.dict();
for (const $each of py.iter(split(items))) {
part = $each;
pieces = split(part, "\\");
plain = py.add(plain, (py.truth(py.at(pieces, 0)) ? [py.at(pieces, 0)] : []));
for (const $each of py.iter(py.text(pieces).slice(1, undefined))) {
piece = $each;
sides = split(piece, ":=");
if (py.truth(py.at(sides, 0))) {
py.put(options, word(py.at(py.at(sides, 0), 0)), (py.same(py.len(sides), 2) ? py.at(sides, 1) : []));
}
}
}
return new _MoveArguments(plain, options);
return null;
}
function _that_keep_parameters(files) {
let changeable, code, found, k, names, statement;
found = new Set((() => { const $out = []; for (const code of py.iter(files)) { for (const step of py.iter(code.steps)) { if (py.truth(step.routine)) $out.push(step.routine); } } return $out; })());
for (const $each of py.iter(files)) {
code = $each;
changeable = new py.Dict((() => { const $out = []; for (const [k, step] of py.iter(py.enumerate(code.steps))) { if (py.truth(step.routine)) $out.push([k, py.set(formal_names(py.at(code.statements, k), _CHANGEABLE))]); } return $out; })());
for (const $each of py.iter(py.enumerate(code.statements))) {
[k, statement] = $each;
names = py.call(changeable, "get", py.at(code.flow, k).routine, py.set());
if (py.truth(py.both(names, () => py.both(!py.truth(py.at(code.steps, k).routine), () => py.and(_touched(statement, py.at(code.steps, k)), names))))) {
found = py.sub(found, new Set([code.routine(k)]));
}
}
}
return found;
return null;
}
function _touched(statement, step) {
let first, found, group, name, sides;
first = word(py.at(statement.items, 0));
found = py.set();
sides = split(statement.items, ":=");
if (py.truth(py.both(py.same(py.len(sides), 2), () => py.both(!py.has(MOTIONS, first), () => is_assignment(statement.items))))) {
py.call(found, "add", py.at(element_name(py.at(sides, 0)), 0));
} else {
if (!py.truth(py.either(step.opens, () => py.either(step.closes, () => py.either(step.is_jump, () => py.has(MOTIONS, first)))))) {
found = py.or(found, py.set(words_in(py.text(statement.items).slice(1, undefined))));
}
}
for (const $each of py.iter(calls_in(statement.items))) {
[name, group] = $each;
if (!py.has(RAPID_FUNCTIONS, py.call(name, "upper"))) {
found = py.or(found, new Set((() => { const $out = []; for (const part of py.iter(group.parts)) { $out.push(py.at(element_name(part), 0)); } return $out; })()));
}
}
return found;
return null;
}
function _lists(group) {
let inner, lists;
inner = (() => { const $out = []; for (const part of py.iter(group.parts)) { $out.push(aggregate(part, "[")); } return $out; })();
lists = (() => { const $out = []; for (const each of py.iter(inner)) { $out.push((((each) ?? null) !== (null) ? numbers_of(each.parts) : null)); } return $out; })();
return (!py.has(lists, null) ? (() => { const $out = []; for (const each of py.iter(lists)) { if (((each) ?? null) !== (null)) $out.push(each); } return $out; })() : null);
return null;
}
function _posture(conf) {
let shape, turns;
if (py.truth(py.either(py.any((() => { const $out = []; for (const number of py.iter(conf)) { $out.push(!py.same(number.value, py.round(number.value))); } return $out; })()), () => !(((0 <= py.at(conf, 3).value) && (py.at(conf, 3).value <= 7)))))) {
return null;
}
shape = py.int(py.at(conf, 3).value);
turns = py.tuple((() => { const $out = []; for (const [k, joint] of py.iter(py.enumerate([0, 3, 5]))) { $out.push(new Turn(joint, "quarter", py.int(py.at(conf, k).value), py.at(conf, k))); } return $out; })());
return new Posture(!py.truth(py.and(shape, 4)), !py.truth(py.and(shape, 2)), !py.truth(py.and(shape, 1)), turns);
return null;
}
function _in_zone(text) {
let commas, depth, end, k, letter, start;
depth = 0;
commas = [];
start = 0;
for (const $each of py.iter(py.enumerate(text))) {
[k, letter] = $each;
depth = py.add(depth, py.sub(py.has("([{", letter), py.has(")]}", letter)));
if (py.truth(py.both(py.same(letter, ","), () => !py.truth(depth)))) {
py.call(commas, "append", k);
}
}
if ((py.len(commas) < 3)) {
return text;
}
start = py.add(py.at(commas, 1), 1);
end = py.at(commas, 2);
return py.add(py.add(py.text(text).slice(undefined, start), " z0"), py.text(text).slice(end, undefined));
return null;
}
return { _SEARCHES, _STORAGE, _TARGETS, _DATA, _CHANGEABLE, Rapid, _ModuleReader, _MoveArguments, _arguments, _that_keep_parameters, _touched, _lists, _posture, _in_zone };
})();
MODULES.urscript = (() => {
const { Draft } = MODULES.draft;
const { Code, InForce, Step, followed } = MODULES.flow;
const { ControllerLanguage } = MODULES.language;
const { POSITIONS, STATED_LOAD } = MODULES.line_flow;
const { Frame, Motion, Path, Point, Posture, Program, Skipped } = MODULES.program;
const { Entries, Reader } = MODULES.statement_reader;
const { Brackets, Statement, aggregate, call_of, calls_in, element_name, is_token, nested, number_of, numbers_of, place_of, split, text_of_items } = MODULES.syntax;
const { Understood, understood_words } = MODULES.understood;
let _TOKENS;
_TOKENS = "\nTEXT: /\"[^\"\\r\\n]*\"/ | /'[^'\\r\\n]*'/\nBITS.3: /0[xXbB][0-9a-fA-F]+/\nSIGN: /[=\u003c\u003e!]=|[^\\x04\\s\\w()\\[\\]{}\"'#$]/\n_END: /\\r\\n|\\r|\\n|\\x04/\nCOMMENT.5: /#[^\\r\\n]*/\n%ignore COMMENT\n%ignore /[ \\t\\f\\xa0]+/\n";
let _WORDS;
_WORDS = "URScript: def, thread, if, while and for, each with its end";
let _MOTIONS;
_MOTIONS = new py.Dict([["movej", "joint"], ["movel", "line"], ["movep", "line"], ["movec", "circle"]]);
let _ENDLESS;
_ENDLESS = ["servoj", "servoc", "servol", "speedj", "speedl"];
let _MANUAL;
_MANUAL = "Universal Robots, script manual (PolyScope 5)";
let _SCRIPT_WORDS;
_SCRIPT_WORDS = [new Understood("function", (py.str(_MANUAL) + ": module motion (ends of motions, kinematics; no motion of its own)"), "stopj, stopl, stops, force_mode_set_damping, force_mode_set_gain_scaling, get_freedrive_status, get_conveyor_tick_count, set_conveyor_tick_count, conveyor_pulse_decode, encoder_enable_pulse_decode, encoder_enable_set_tick_count, encoder_get_tick_count, encoder_set_tick_count, encoder_unwind_delta_tick_count, position_deviation_warning, is_within_safety_limits, is_steady"), new Understood("function", (py.str(_MANUAL) + ": module internals"), "get_actual_joint_positions, get_actual_joint_positions_history, get_actual_joint_speeds, get_actual_tcp_pose, get_actual_tcp_speed, get_actual_tool_flange_pose, get_controller_temp, get_forward_kin, get_inverse_kin, get_inverse_kin_has_solution, get_joint_temp, get_joint_torques, get_steptime, get_target_joint_positions, get_target_joint_speeds, get_target_payload, get_target_payload_cog, get_target_payload_inertia, get_target_tcp_pose, get_target_tcp_speed, get_target_waypoint, get_tcp_force, get_tcp_offset, get_tool_accelerometer_reading, get_tool_current, popup, powerdown, sleep, str_at, str_cat, str_empty, str_find, str_len, str_sub, sync, textmsg, to_num, to_str, assert, time, force, rpc_factory, get_target_tcp_pose_along_path, get_target_tcp_speed_along_path, set_payload, set_payload_cog, set_payload_mass, set_target_payload, set_gravity, set_flag, get_flag, halt, rtde_set_watchdog, request_boolean_from_primary_client, request_float_from_primary_client, request_integer_from_primary_client, request_string_from_primary_client"), new Understood("function", (py.str(_MANUAL) + ": module urmath"), "acos, asin, atan, atan2, binary_list_to_integer, ceil, cos, d2r, floor, get_list_length, length, integer_to_binary_list, interpolate_pose, inv, list_append, list_insert, list_remove, list_extend, list_clear, log, norm, normalize, point_dist, pose_add, pose_dist, pose_inv, pose_sub, pose_trans, pow, r2d, random, rotvec2rpy, rpy2rotvec, sin, size, sqrt, tan, transpose, wrench_trans, struct, True, False, and, or, not, xor, mod, if, elif, while, return, p, run, join, kill"), new Understood("function", (py.str(_MANUAL) + ": module interfaces"), "get_analog_in, get_analog_out, get_configurable_digital_in, get_configurable_digital_out, get_digital_in, get_digital_out, get_euromap_input, get_euromap_output, get_standard_analog_in, get_standard_analog_out, get_standard_digital_in, get_standard_digital_out, get_tool_analog_in, get_tool_digital_in, get_tool_digital_out, modbus_add_signal, modbus_delete_signal, modbus_get_signal_status, modbus_send_custom_command, modbus_set_output_register, modbus_set_output_signal, modbus_set_runstate_dependent_choice, modbus_set_signal_update_frequency, read_input_boolean_register, read_input_float_register, read_input_integer_register, read_output_boolean_register, read_output_float_register, read_output_integer_register, read_port_bit, read_port_register, set_analog_inputrange, set_analog_out, set_analog_outputdomain, set_configurable_digital_out, set_digital_out, set_euromap_output, set_euromap_runstate_dependent_choice, set_runstate_configurable_digital_output_to_value, set_runstate_standard_analog_output_to_value, set_runstate_standard_digital_output_to_value, set_runstate_tool_digital_output_to_value, set_standard_analog_input_domain, set_standard_analog_out, set_standard_digital_out, set_tool_analog_input_domain, set_tool_communication, set_tool_digital_out, set_tool_digital_output_mode, set_tool_output_mode, set_tool_voltage, socket_close, socket_get_var, socket_open, socket_read_ascii_float, socket_read_binary_integer, socket_read_byte_list, socket_read_line, socket_read_string, socket_send_byte, socket_send_int, socket_send_line, socket_send_string, socket_set_var, write_output_boolean_register, write_output_float_register, write_output_integer_register, write_port_bit, write_port_register, zero_ftsensor, set_input_actions_to_default, set_standard_digital_input_action, set_tool_digital_input_action, set_configurable_digital_input_action, set_gp_boolean_input_action, enter_critical, exit_critical, set_safety_mode_transition_hardness")];
let _HARMLESS;
_HARMLESS = understood_words(_SCRIPT_WORDS, "function");
let _SWITCHES;
_SWITCHES = new py.Dict([["set_tcp", "tcp"], ["set_payload", STATED_LOAD], ["set_payload_mass", STATED_LOAD], ["set_target_payload", STATED_LOAD], ["path_offset_enable", "path_offset"], ["path_offset_disable", "path_offset"], ["track_conveyor_linear", "conveyor"], ["track_conveyor_circular", "conveyor"], ["stop_conveyor_tracking", "conveyor"], ["force_mode", "force"], ["end_force_mode", "force"], ["freedrive_mode", "freedrive"], ["end_freedrive_mode", "freedrive"], ["teach_mode", "freedrive"], ["end_teach_mode", "freedrive"], ["screw_driving", "force"], ["end_screw_driving", "force"]]);
let _ENDS_IT;
_ENDS_IT = ["path_offset_disable", "stop_conveyor_tracking", "end_force_mode", "end_freedrive_mode", "end_teach_mode", "end_screw_driving"];
let _MODE;
_MODE = 5;
let _OPENS;
_OPENS = new py.Dict([["def", "routine"], ["thread", "routine"], ["sec", "routine"], ["while", "loop"], ["for", "loop"], ["if", "branch"]]);
class UrScript extends ControllerLanguage {
read(sources) {
let code, displaced, draft, entries, files, harmless, i, k, reader, switched;
draft = new Draft(sources);
files = (() => { const $out = []; for (const source of py.iter(sources)) { $out.push(_code(source)); } return $out; })();
files = followed(files, py.frozenset(new Set([POSITIONS])), _ends_displacement);
switched = new Set((() => { const $out = []; for (const code of py.iter(files)) { for (const step of py.iter(code.steps)) { for (const name of py.iter(step.sets)) { $out.push(name); } } } return $out; })());
displaced = py.sorted(py.sub(new Set([POSITIONS, ...py.iter(switched)]), new Set(["tcp", STATED_LOAD])));
entries = new Entries(files, _ends_displacement);
for (const $each of py.iter(py.enumerate(files))) {
[i, code] = $each;
harmless = py.frozenset((() => { const $out = []; for (const statement of py.iter(code.statements)) { for (const [name, ] of py.iter(calls_in(statement.items))) { $out.push(name); } } return $out; })());
reader = new _ScriptReader(draft, i, code, harmless, entries, this, displaced);
for (const $each of py.iter(py.range(py.len(code.statements)))) {
k = $each;
reader.statement(k);
}
}
return draft.finish();
return null;
}
key(name) {
return name;
return null;
}
statement(motion, source, values, posture) {
let end, pose, start;
[start, end] = [...py.iter(motion.span)];
pose = py.call(",", "join", (() => { const $out = []; for (const [k, value] of py.iter(py.enumerate(values))) { $out.push((py.format(value, ("." + py.str(((k < 3) ? 7 : 8)) + "f")))); } return $out; })());
return py.add(py.add(py.text(source.text).slice(motion.statement.start, start), ("p[" + py.str(pose) + "]")), py.text(source.text).slice(end, motion.statement.end));
return null;
}
}
UrScript.prototype.name = "URScript";
UrScript.prototype.suffixes = [".script", ".urscript", ".ur"];
UrScript.prototype.length = 1.0;
UrScript.prototype.convention = "ur";
UrScript.prototype.in_degrees = false;
UrScript.prototype.digits = [7, 8, 9];
UrScript.prototype.can_insert = true;
UrScript.prototype.grammars = [nested(_TOKENS, true)];
UrScript.prototype.understood = _SCRIPT_WORDS;
LANGUAGES.register(UrScript);
class _ScriptReader extends Reader {
constructor(draft = null, file = null, code = null, harmless = null, entries = null, language = null, displacements = null) {
super();
this.draft = draft;
this.file = file;
this.code = code;
this.harmless = harmless;
this.entries = entries;
this.language = language;
this.displacements = displacements;
}
literal(line, name, items) {
let group, is_pose, numbers;
is_pose = py.both(py.same(py.len(items), 2), () => py.both(is_token(py.at(items, 0), "WORD"), () => py.same(py.str(py.at(items, 0)), "p")));
group = aggregate((py.truth(is_pose) ? py.text(items).slice(1, undefined) : items), "[");
numbers = (((group) ?? null) !== (null) ? numbers_of(group.parts) : null);
if (py.truth(py.either(((numbers) ?? null) === (null), () => !py.same(py.len(numbers), 6)))) {
return null;
}
return new Point(name, this.file, line, (py.truth(is_pose) ? "pose" : "joints"), numbers);
return null;
}
statement(k) {
let call, is_part, items, known, line, lost, name, rest, sides, statement;
statement = py.at(this.statements, k);
known = py.at(this.flow, k);
items = statement.items;
line = statement.line;
call = call_of(statement.items);
if (py.truth(py.both(((call) ?? null) !== (null), () => py.has(_MOTIONS, py.at(call, 0))))) {
this._move(k, ...py.iter(call));
return null;
}
if (py.truth(py.both(((call) ?? null) !== (null), () => py.has(_ENDLESS, py.at(call, 0))))) {
lost = this.skip((py.str(py.at(call, 0)) + " of line " + py.str(line)), line, "a motion without an end point of its own");
py.call(this.draft.motions, "append", new Motion("joint", [lost], statement, this.file, undefined, undefined, undefined, known.run));
}
rest = (py.truth(is_token(py.at(items, 0), "WORD", "GLOBAL", "LOCAL")) ? py.text(items).slice(1, undefined) : items);
sides = split(rest, "=");
[name, is_part] = [...py.iter(element_name(py.at(sides, 0), true))];
if (py.truth(py.both(py.same(py.len(sides), 2), () => py.both(name, () => !py.truth(py.at(this.steps, k).opens))))) {
this.assign(line, name, is_part, py.at(sides, 1));
} else {
if (!py.truth(py.at(this.steps, k).routine)) {
this.draft.read(this.words(items));
}
}
return null;
}
assign(line, name, is_part, value) {
let group, point, points;
group = aggregate(value, "[");
if (py.truth(py.both(((group) ?? null) !== (null), () => py.both(!py.truth(is_part), () => py.both(!py.has(name, "["), () => ((this.literal(line, name, value)) ?? null) === (null)))))) {
points = (() => { const $out = []; for (const [k, part] of py.iter(py.enumerate(group.parts))) { $out.push(this.literal(line, (py.str(name) + "[" + py.str(k) + "]"), part)); } return $out; })();
if (py.truth(py.all((() => { const $out = []; for (const point of py.iter(points)) { $out.push(py.isinstance(point, [Point])); } return $out; })()))) {
for (const $each of py.iter(points)) {
point = $each;
this.draft.declare(point);
}
return null;
}
}
if (py.has(name, "[")) {
this.draft.write(py.at(py.call(name, "partition", "["), 0), ("line " + py.str(line) + " sets a part of it"));
}
super.assign(line, name, py.either(is_part, () => py.has(name, "[")), value);
return null;
}
target(k, part) {
let call, found, near, others, target;
call = call_of(part);
if (py.truth(py.either(((call) ?? null) === (null), () => py.either(!py.same(py.at(call, 0), "get_inverse_kin"), () => !py.truth(py.at(call, 1).items))))) {
return super.target(k, part);
}
[target, ...others] = [...py.iter(py.at(call, 1).parts)];
near = (() => { const $out = []; for (const other of py.iter(others)) { for (const name of py.iter(py.sorted(this.words(other)))) { if (!py.same(name, "qnear")) $out.push(name); } } return $out; })();
this.draft.read(near);
found = super.target(k, target);
if (py.truth(py.both(near, () => py.isinstance(found, ["str"])))) {
py.put(this.draft.near, found, py.at(near, -1));
}
return found;
return null;
}
_move(k, called, arguments_) {
let count, displaced, given, known, path, places, statement, targets, why;
statement = py.at(this.statements, k);
known = py.at(this.flow, k);
given = _arguments(arguments_);
path = py.at(_MOTIONS, called);
count = (py.same(path, "circle") ? 2 : 1);
places = given.places(count);
if ((py.len(places) < count)) {
this.not_understood(called, statement.line);
return null;
}
targets = py.tuple((() => { const $out = []; for (const part of py.iter(places)) { $out.push(this.target(k, part)); } return $out; })());
if (py.truth(py.both(py.same(path, "circle"), () => !py.has(["", "0"], given.mode)))) {
why = ("line " + py.str(statement.line) + " does not turn the tool to its orientation (mode)");
targets = [py.at(targets, 0), this.left(py.at(targets, 1), why)];
}
displaced = this.displaced(k, this.displacements);
py.call(this.draft.motions, "append", new Motion(path, targets, statement, this.file, this._tool(known), (py.truth(displaced) ? new Frame("", undefined, displaced) : new Frame("base", np.eye(4))), place_of(py.at(places, -1)), known.run, py.same(path, "line"), undefined, this.load(k), displaced));
return null;
}
mass(statement) {
let call, number;
call = call_of(statement.items);
number = (py.truth(py.both(((call) ?? null) !== (null), () => py.at(call, 1).parts)) ? number_of(py.at(py.at(call, 1).parts, 0)) : null);
return (((number) ?? null) !== (null) ? number.value : null);
return null;
}
_tool(known) {
let call, found, point;
found = py.call(known.setters, "get", "tcp");
if (!py.truth(py.isinstance(found, ["int"]))) {
return new Frame("tcp", undefined, (((found) ?? null) !== (null) ? ("set_tcp: " + py.str(found)) : ""));
}
call = call_of(py.at(this.statements, found).items);
point = (py.truth(py.both(((call) ?? null) !== (null), () => py.at(call, 1).parts)) ? this.literal(0, "tcp", py.at(py.at(call, 1).parts, 0)) : null);
if (py.truth(py.both(py.isinstance(point, [Point]), () => !py.truth(this.language.is_pose(point.values))))) {
return new Frame("tcp", undefined, ("line " + py.str(py.at(this.statements, found).line) + " sets what is no pose"));
}
if (py.truth(py.both(py.isinstance(point, [Point]), () => py.same(point.kind, "pose")))) {
return new Frame("tcp", this.language.pose(point.values));
}
return new Frame("tcp", undefined, ("line " + py.str(py.at(this.statements, found).line) + " sets a computed tool"));
return null;
}
}
_ScriptReader.prototype.case = true;
class _ScriptArguments {
constructor(plain = null, named = null) {
this.plain = plain;
this.named = named;
}
places(count) {
let names;
if ((py.len(this.plain) >= count)) {
return py.text(this.plain).slice(undefined, count);
}
names = ["pose_via", "pose_to", "pose", "q"];
return (() => { const $out = []; for (const name of py.iter(names)) { if (py.has(this.named, name)) $out.push(py.at(this.named, name)); } return $out; })();
return null;
}
get mode() {
let is_plain;
is_plain = (py.len(this.plain) > _MODE);
return text_of_items((py.truth(is_plain) ? py.at(this.plain, _MODE) : py.call(this.named, "get", "mode", [])));
return null;
}
}
function _arguments(brackets) {
let named, part, plain;
named = py.dict();
plain = [];
for (const $each of py.iter(brackets.parts)) {
part = $each;
if (py.truth(py.both((py.len(part) > 2), () => is_token(py.at(part, 1), "SIGN", "=")))) {
py.put(named, py.str(py.at(part, 0)), py.text(part).slice(2, undefined));
} else {
if (py.truth(part)) {
py.call(plain, "append", part);
}
}
}
return new _ScriptArguments(plain, named);
return null;
}
function _code(source) {
let statements, steps;
statements = source.statements(_TOKENS, _WORDS, true);
steps = (() => { const $out = []; for (const statement of py.iter(statements)) { $out.push(_step(statement)); } return $out; })();
if (!py.truth(py.any((() => { const $out = []; for (const [statement, step] of py.iter(py.zip(statements, steps))) { $out.push(py.either(step.opens, () => ((call_of(statement.items)) ?? null) !== (null))); } return $out; })()))) {
throw source.error(("no statement that calls or defines anything; expected " + py.str(_WORDS)), 0);
}
return new Code(source, statements, steps);
return null;
}
function _ends_displacement(statement) {
return py.has(_ENDS_IT, py.str(py.at(statement.items, 0)));
return null;
}
function* _called(items) {
let is_call, item, k;
for (const $each of py.iter(py.enumerate(items))) {
[k, item] = $each;
if (!py.truth(py.isinstance(item, [Brackets]))) {
continue;
}
is_call = py.both(py.same(item.kind, "("), () => py.both((k > 0), () => is_token(py.at(items, py.sub(k, 1)), "WORD")));
if (py.truth(py.both(is_call, () => !py.truth(py.both((k > 1), () => is_token(py.at(items, py.sub(k, 2)), "SIGN", ".")))))) {
(yield py.str(py.at(items, py.sub(k, 1))));
}
(yield* py.iter(_called(item.items)));
}
}
function _step(statement) {
let calls, first, items, kind, name;
items = statement.items;
first = (py.truth(is_token(py.at(items, 0), "WORD")) ? py.str(py.at(items, 0)) : "");
kind = py.call(_OPENS, "get", first, "");
calls = py.tuple((() => { const $out = []; for (const name of py.iter(_called(items))) { if (py.truth(py.both(!py.has(_HARMLESS, name), () => py.both(!py.has(_SWITCHES, name), () => py.both(!py.has(_MOTIONS, name), () => !py.has(_ENDLESS, name)))))) $out.push(name); } return $out; })());
if (py.same(kind, "routine")) {
name = py.next((() => { const $out = []; for (const item of py.iter(py.text(items).slice(1, undefined))) { if (py.truth(is_token(item, "WORD"))) $out.push(py.str(item)); } return $out; })(), first);
return new Step(first, undefined, name, undefined, undefined, undefined, undefined, undefined, undefined, (py.same(first, "thread") ? [name] : []));
}
if (py.truth(kind)) {
return new Step(first, undefined, undefined, py.same(kind, "loop"), undefined, undefined, undefined, undefined, calls);
}
if (py.truth(py.both(py.same(first, "end"), () => py.same(py.len(items), 1)))) {
return new Step(undefined, py.tuple(_OPENS));
}
if (py.has(["elif", "else"], first)) {
return new Step(undefined, undefined, undefined, undefined, true, undefined, undefined, undefined, calls);
}
return new Step(undefined, undefined, undefined, undefined, undefined, undefined, (py.has(_SWITCHES, first) ? py.frozenset(new Set([py.at(_SWITCHES, first)])) : py.frozenset()), undefined, calls);
return null;
}
return { _TOKENS, _WORDS, _MOTIONS, _ENDLESS, _MANUAL, _SCRIPT_WORDS, _HARMLESS, _SWITCHES, _ENDS_IT, _MODE, _OPENS, UrScript, _ScriptReader, _ScriptArguments, _arguments, _code, _ends_displacement, _called, _step };
})();